"""`samii-rig frf` and `samii-rig report`: results from recordings that exist."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from samii_rig.cli.common import (
    FIGURES,
    JsonOption,
    Logs,
    check_target,
    comparisons,
    response_json,
    rig_of,
    rigs,
    say_json,
    without_rig,
)
from samii_rig.cli.options import takes
from samii_rig.errors import EstimateError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.console import Console

    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.progress import Progress
    from samii_rig.report.compare import ModelCurve
    from samii_rig.report.modes import Modes
    from samii_rig.rig.schema import Rig
    from samii_rig.signal.choose import Method
    from samii_rig.signal.gather import Gaps
    from samii_rig.types import FrequencyResponse, Recording

# The words of `samii_rig.signal`, which takes a second to import; a test holds them to it.
METHODS = ("auto", "burst", "periodic", "local", "h1", "h2", "hv")
GAPS = ("auto", "refuse", "exclude", "model")
ALL = (0.0, float("inf"))  # Hz: every line that was estimated

RigOverride = Annotated[
    str | None,
    typer.Option(
        "--rig",
        help="Rig to lay over the data [default: the one they carry]",
        autocompletion=rigs,
    ),
]
InputOption = Annotated[
    list[str] | None,
    typer.Option("--input", help="Input channel; may be repeated [default: those that move]."),
]
OutputOption = Annotated[
    list[str] | None, typer.Option("--output", help="Output channel; may be repeated.")
]
MethodOption = Annotated[
    str, typer.Option(help="auto, burst, periodic, local, h1, h2 or hv (Welch).")
]
GapsOption = Annotated[
    str,
    typer.Option(
        help="A segment that misses samples: refuse, exclude or model it; auto excludes it while "
        "others are left, else models it."
    ),
]
BandOption = Annotated[
    tuple[float, float] | None, typer.Option(help="Lowest and highest frequency, Hz.")
]
PoseOption = Annotated[
    list[str] | None,
    typer.Option(
        help='The rig\'s angle to the way down in each recording, in their order, as "30 deg" '
        "[default: that of the rig file which each carries]."
    ),
]


@dataclass(frozen=True, kw_only=True)
class Estimating:
    """Which frequency responses are estimated, and how."""

    input_: InputOption = None
    output: OutputOption = None
    method: MethodOption = "auto"
    gaps: GapsOption = "refuse"
    band: BandOption = None

    def check(self, logs: list[Path]) -> None:
        """InputError for options that no estimate can have, before it is imported."""
        from samii_rig.cli.arguments import check_band, check_channels, check_choice

        check_choice("--method", self.method, METHODS)
        check_choice("--gaps", self.gaps, GAPS)
        check_band(self.band)
        check_channels("--input", self.input_, logs)
        check_channels("--output", self.output, logs)

    def of(self, recordings: Sequence[Recording]) -> tuple[FrequencyResponse, ...]:
        """Frequency responses by the options of the command line."""
        from samii_rig.signal.estimate import estimate

        # `estimate` itself refuses names that it does not know.
        try:
            return estimate(
                recordings,
                input=self.input_ or None,
                outputs=self.output,
                method=cast("Method", self.method),
                gaps=cast("Gaps", self.gaps),
                band=self.band,
            )
        except EstimateError as error:  # its advice in the words of the command line
            said = re.sub(r"(gaps|input)='(\w+)'", r"--\1 \2", str(error))
            raise type(error)(said) from error


@dataclass(frozen=True, kw_only=True)
class FrfOptions(Estimating):
    """Words of `samii-rig frf`."""

    logs: Logs
    rig: RigOverride = None
    export: Annotated[
        list[Path] | None,
        typer.Option(
            help="Write a .csv, .npz, .mat or .uff file, replaced if it exists; of several levels "
            "one each, as NAME_0.5_V.csv. May be repeated."
        ),
    ] = None
    save: Annotated[
        Path | None,
        typer.Option(help="Write a new .mcap of the results that names its sources."),
    ] = None
    json: JsonOption = False


@takes(FrfOptions)
def frf(o: FrfOptions) -> None:
    """Estimate frequency responses with their uncertainty; recordings of one level are pooled.

    The method is chosen from what the recordings hold, and said. Several inputs are told apart by
    experiments in turn or together (docs/method/several-inputs.md).

    Example: samii-rig frf runs/*.mcap --export frf.csv --save frf.mcap
    """
    from samii_rig.cli.arguments import check_logs, check_rig

    check_rig(o.rig)
    check_logs(o.logs)
    o.check(o.logs)
    for path in o.export or ():
        check_target("--export", path, (".csv", ".npz", ".mat", ".uff"), o.logs)
    if o.save:
        check_target("--save", o.save, (".mcap",), o.logs)
        if o.save.exists():
            said = f"{o.save} is there already; delete it, or name another file"
            raise InputError.saying("--save", "", said)

    from rich.console import Console

    from samii_rig.report.compare import model_curve
    from samii_rig.report.facts import names
    from samii_rig.report.summary import summary

    recordings = read_all(o.logs)
    responses = o.of(recordings)
    held = rig_of(recordings, o.rig)
    if o.save and held and len(recordings) > 1:
        _of_one_state(recordings, held[0], lambda one: o.of([one]))
    curve = model_curve(held[0], responses) if held else None
    written = _exported(o, recordings, responses)
    if o.json:
        say_json(
            {
                "responses": [response_json(r) for r in responses],
                "model_over_measurement": comparisons(responses, curve),
                "written": written,
            }
        )
        return
    console = Console(highlight=False)
    console.print(summary(recordings, responses, curve, o.band or ALL))
    for r, name in zip(responses, names(responses), strict=True):
        console.print(f"\n{name}: {r.method}. {r.why}")
    say_written(console, written)


def _exported(
    o: FrfOptions, recordings: Sequence[Recording], responses: Sequence[FrequencyResponse]
) -> list[Path]:
    """The files that --export and --save ask for."""
    from samii_rig.record.derived import save_frequency_responses
    from samii_rig.record.export import export_response

    written = []
    for path in o.export or ():
        targets = _one_a_level(path, responses)
        written += [export_response(t, r) for t, r in zip(targets, responses, strict=True)]
    if o.save:
        carried = {r.rig_toml for r in recordings}
        rig_toml = carried.pop() if len(carried) == 1 else ""
        save_frequency_responses(o.save, responses, o.logs, rig_toml=rig_toml)
        written.append(o.save)
    return written


@dataclass(frozen=True, kw_only=True)
class ReportOptions(Estimating):
    """Words of `samii-rig report`."""

    logs: Logs
    rig: RigOverride = None
    out: Annotated[
        Path | None,
        typer.Option(
            help="The page (.html), replaced if it exists [default: beside the first recording; "
            "none if there is a --figure]"
        ),
    ] = None
    figure: Annotated[
        list[Path] | None,
        typer.Option(
            help="The Bode diagram as .png, .svg or .pdf, for a paper; replaced if it exists."
        ),
    ] = None
    diagnosis: Annotated[
        bool,
        typer.Option(
            "--diagnosis", help="Diagnose them first, and show what is found on the page."
        ),
    ] = False
    json: JsonOption = False

    @property
    def page(self) -> Path | None:
        """Where the page goes, if one is asked for."""
        return self.out or (None if self.figure else self.logs[0].with_suffix(".html"))


@takes(ReportOptions)
def report(o: ReportOptions) -> None:
    """Write one self-contained HTML page about recordings: works offline, interactive.

    Example: samii-rig report runs/*.mcap --out report.html --figure bode.svg
    """
    from samii_rig.cli.arguments import check_logs, check_rig

    check_rig(o.rig)
    check_logs(o.logs)
    o.check(o.logs)
    if o.page is not None:
        check_target("--out", o.page, (".html",), o.logs)
    for path in o.figure or ():
        check_target("--figure", path, FIGURES, o.logs)

    from rich.console import Console

    from samii_rig.report.compare import model_curve
    from samii_rig.report.modes import modes_of_all
    from samii_rig.report.summary import summary, working

    console = Console(highlight=False)
    with working("report", quiet=o.json) as say:
        say("recordings")
        recordings = read_all(o.logs)
        held = rig_of(recordings, o.rig)
        rig = held[0] if held else None
        in_pose = _of_one_pose(recordings, rig) if o.diagnosis else None
        say("frequency responses")
        responses = o.of(recordings)
        curve = model_curve(rig, responses) if rig else None
        found = _diagnosed(o, in_pose, recordings, responses, say) if in_pose else None
        say("modes")
        modes = modes_of_all(responses, rig)
        written = _written(o, _Shown(recordings, responses, rig, curve, found, modes), say)
    if o.json:
        say_json({"written": written, "model_over_measurement": comparisons(responses, curve)})
        return
    console.print(summary(recordings, responses, curve, o.band or ALL, modes))
    say_written(console, written)


def _diagnosed(
    o: ReportOptions,
    in_pose: Rig,
    recordings: list[Recording],
    responses: Sequence[FrequencyResponse],
    say: Progress,
) -> Diagnosis:
    from samii_rig.diagnose.diagnose import diagnose
    from samii_rig.progress import ahead

    return diagnose(
        responses,
        in_pose,
        band=o.band,
        runs=recordings,
        progress=lambda stage: say(ahead("diagnosis: ", stage, whole=True)),
    )


@dataclass(frozen=True, slots=True)
class _Shown:
    """What a page is about."""

    recordings: Sequence[Recording]
    responses: Sequence[FrequencyResponse]
    rig: Rig | None
    curve: ModelCurve | None
    diagnosis: Diagnosis | None
    modes: Sequence[Modes]


def _written(o: ReportOptions, shown: _Shown, say: Progress) -> list[Path]:
    """Page and figures."""
    from samii_rig.record.reader import read_events
    from samii_rig.report.figures import bode_figure, save_figure
    from samii_rig.report.page import Subject, write_report

    written = []
    if o.page is not None:
        say("the page")
        write_report(
            o.page,
            Subject(
                shown.recordings,
                shown.responses,
                shown.rig,
                shown.curve,
                band_hz=o.band or ALL,
                events=[event for path in o.logs for event in read_events(path)],
                modes=shown.modes,
            ),
            diagnosis=shown.diagnosis,
        )
        written.append(o.page)
    for path in o.figure or ():
        say(f"the figure {path.name}")
        written.append(save_figure(path, bode_figure(shown.responses, shown.curve)))
    return written


def say_written(console: Console, written: Sequence[object]) -> None:
    """A line for each file."""
    for path in written:
        console.print(f"written  {path}", soft_wrap=True)


def _of_one_pose(recordings: list[Recording], rig: Rig | None) -> Rig:
    """The rig in the pose of recordings that are to be diagnosed; InputError for several."""
    from samii_rig.diagnose.posed import one_pose
    from samii_rig.identify.poses import at_pose, poses_of

    if rig is None:
        raise without_rig()
    expected = "recordings in one pose; samii-rig diagnose takes those of several"
    return at_pose(rig, one_pose(poses_of(recordings, rig, ()), "--diagnosis", expected))


def _of_one_state(
    recordings: Sequence[Recording],
    rig: Rig,
    alone: Callable[[Recording], Sequence[FrequencyResponse]],
) -> None:
    """InputError for recordings of several states of the rig: in one file of responses nobody could
    tell them apart any more. alone : the responses of one by itself."""
    from samii_rig.diagnose.fit.agreeing import states_of

    each = []
    for one in recordings:
        # What gives no response by itself shows no state either.
        with suppress(EstimateError):
            each.append((one.source, alone(one)))
    states = states_of(each, rig) if len(each) > 1 else ()
    if len(states) > 1:
        told = "; ".join(", ".join(names) for names in states)
        raise InputError.saying(
            "--save",
            "",
            f"the recordings are of {len(states)} states of the rig ({told}); expected those of "
            "one in a file",
        )


def read_all(logs: Sequence[Path]) -> list[Recording]:
    """All recordings; RecordingError names the first that cannot be read."""
    from samii_rig.record.reader import read_recording

    return [read_recording(path) for path in logs]


def _one_a_level(path: Path, responses: Sequence[FrequencyResponse]) -> list[Path]:
    """The path itself for one response, else one name each that tells which it is."""
    from samii_rig.report.facts import names

    if len(responses) == 1:
        return [path]
    words = (re.sub(r"[^\w.+-]+", "_", name).strip("_") for name in names(responses))
    return [path.with_name(f"{path.stem}_{word}{path.suffix}") for word in words]
