"""`samii-rig frf` and `samii-rig report`: results from recordings that exist."""

from __future__ import annotations

import re
from contextlib import suppress
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
from samii_rig.errors import EstimateError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from samii_rig.rig.schema import Rig
    from samii_rig.signal.choose import Method
    from samii_rig.signal.gather import Gaps
    from samii_rig.types import FrequencyResponse, Recording

# The words of `samii_rig.signal`, which takes a second to import; a test holds them to it.
METHODS = ("auto", "burst", "periodic", "local", "h1", "h2", "hv")
GAPS = ("refuse", "exclude", "model")
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
    str, typer.Option(help="A segment that misses samples: refuse, exclude or model it.")
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


def frf(
    logs: Logs,
    rig: RigOverride = None,
    input_: InputOption = None,
    output: OutputOption = None,
    method: MethodOption = "auto",
    gaps: GapsOption = "refuse",
    band: BandOption = None,
    export: Annotated[
        list[Path] | None,
        typer.Option(
            help="Write a .csv, .npz, .mat or .uff file, replaced if it exists; of several levels "
            "one each, as NAME_0.5_V.csv. May be repeated."
        ),
    ] = None,
    save: Annotated[
        Path | None,
        typer.Option(help="Write a new .mcap of the results that names its sources."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Estimate frequency responses with their uncertainty; recordings of one level are pooled.

    The method is chosen from what the recordings hold, and said. Several inputs are told apart by
    experiments in turn or together (docs/method/several-inputs.md).

    Example: samii-rig frf runs/*.mcap --export frf.csv --save frf.mcap
    """
    from samii_rig.cli.arguments import check_logs, check_rig

    check_rig(rig)
    check_logs(logs)
    check_estimate(method, gaps, band, input_, output, logs)
    for path in export or ():
        check_target("--export", path, (".csv", ".npz", ".mat", ".uff"), logs)
    if save:
        check_target("--save", save, (".mcap",), logs)
        if save.exists():
            raise InputError("--save", "", str(save), "no recording of that name yet")

    from rich.console import Console

    from samii_rig.record.derived import save_frequency_responses
    from samii_rig.record.export import export_response
    from samii_rig.report.compare import model_curve
    from samii_rig.report.facts import names
    from samii_rig.report.summary import summary

    console = Console(highlight=False)
    recordings = read_all(logs)
    responses = estimated(recordings, input_, output, method, gaps, band)
    held = rig_of(recordings, rig)
    if save and held and len(recordings) > 1:
        _of_one_state(
            recordings, held[0], lambda one: estimated([one], input_, output, method, gaps, band)
        )
    curve = model_curve(held[0], responses) if held else None
    written = []
    for path in export or ():
        targets = _one_a_level(path, responses)
        written += [export_response(t, r) for t, r in zip(targets, responses, strict=True)]
    if save:
        carried = {r.rig_toml for r in recordings}
        rig_toml = carried.pop() if len(carried) == 1 else ""
        save_frequency_responses(save, responses, logs, rig_toml=rig_toml)
        written.append(save)
    if json:
        say_json(
            {
                "responses": [response_json(r) for r in responses],
                "model_over_measurement": comparisons(responses, curve),
                "written": written,
            }
        )
        return
    console.print(summary(recordings, responses, curve, band or ALL))
    for r, name in zip(responses, names(responses), strict=True):
        console.print(f"\n{name}: {r.method}. {r.why}")
    for path in written:
        console.print(f"written  {path}", soft_wrap=True)


def report(
    logs: Logs,
    rig: RigOverride = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="The page (.html), replaced if it exists [default: beside the first recording; "
            "none if there is a --figure]"
        ),
    ] = None,
    figure: Annotated[
        list[Path] | None,
        typer.Option(
            help="The Bode diagram as .png, .svg or .pdf, for a paper; replaced if it exists."
        ),
    ] = None,
    input_: InputOption = None,
    output: OutputOption = None,
    method: MethodOption = "auto",
    gaps: GapsOption = "refuse",
    band: BandOption = None,
    diagnosis: Annotated[
        bool,
        typer.Option(
            "--diagnosis", help="Diagnose them first, and show what is found on the page."
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Write one self-contained HTML page about recordings: works offline, interactive.

    Example: samii-rig report runs/*.mcap --out report.html --figure bode.svg
    """
    from samii_rig.cli.arguments import check_logs, check_rig

    check_rig(rig)
    check_logs(logs)
    check_estimate(method, gaps, band, input_, output, logs)
    page = out or (None if figure else logs[0].with_suffix(".html"))
    if page is not None:
        check_target("--out", page, (".html",), logs)
    for path in figure or ():
        check_target("--figure", path, FIGURES, logs)

    from rich.console import Console

    from samii_rig.progress import ahead
    from samii_rig.record.reader import read_events
    from samii_rig.report.compare import model_curve
    from samii_rig.report.figures import bode_figure, save_figure
    from samii_rig.report.modes import modes_of_all
    from samii_rig.report.page import write_report
    from samii_rig.report.summary import summary, working

    console, found = Console(highlight=False), None
    with working(console, "report", quiet=json) as say:
        say("recordings")
        recordings = read_all(logs)
        held = rig_of(recordings, rig)
        in_pose = _of_one_pose(recordings, held[0] if held else None) if diagnosis else None
        say("frequency responses")
        responses = estimated(recordings, input_, output, method, gaps, band)
        curve = model_curve(held[0], responses) if held else None
        if in_pose is not None:
            from samii_rig.diagnose.diagnose import diagnose

            found = diagnose(
                responses, in_pose, band=band, runs=recordings,
                progress=lambda stage: say(ahead("diagnosis: ", stage, whole=True)),
            )  # fmt: skip
        say("modes")
        modes = modes_of_all(responses, held[0] if held else None)
        written = []
        if page is not None:
            say("the page")
            write_report(
                page,
                recordings,
                responses,
                rig=held[0] if held else None,
                model=curve,
                band_hz=band or ALL,
                events=[event for path in logs for event in read_events(path)],
                diagnosis=found,
                modes=modes,
            )
            written.append(page)
        for path in figure or ():
            say(f"the figure {path.name}")
            written.append(save_figure(path, bode_figure(responses, curve)))
    if json:
        say_json({"written": written, "model_over_measurement": comparisons(responses, curve)})
        return
    console.print(summary(recordings, responses, curve, band or ALL, modes))
    for path in written:
        console.print(f"written  {path}", soft_wrap=True)


def check_estimate(
    method: str,
    gaps: str,
    band: tuple[float, float] | None,
    input_: list[str] | None,
    output: list[str] | None,
    logs: list[Path],
) -> None:
    """InputError for options that no estimate can have, before it is imported."""
    from samii_rig.cli.arguments import check_band, check_channels, check_choice

    check_choice("--method", method, METHODS)
    check_choice("--gaps", gaps, GAPS)
    check_band(band)
    check_channels("--input", input_, logs)
    check_channels("--output", output, logs)


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


def read_all(logs: list[Path]) -> list[Recording]:
    """All recordings; RecordingError names the first that cannot be read."""
    from samii_rig.record.reader import read_recording

    return [read_recording(path) for path in logs]


def estimated(
    recordings: list[Recording],
    input_: list[str] | None,
    output: list[str] | None,
    method: str,
    gaps: str,
    band: tuple[float, float] | None,
) -> tuple[FrequencyResponse, ...]:
    """Frequency responses by the options of the command line."""
    from samii_rig.signal.estimate import estimate

    # `estimate` itself refuses names that it does not know.
    try:
        return estimate(
            recordings,
            input=input_ or None,
            outputs=output,
            method=cast("Method", method),
            gaps=cast("Gaps", gaps),
            band=band,
        )
    except EstimateError as error:  # its advice in the words of the command line
        said = re.sub(r"(gaps|input)='(\w+)'", r"--\1 \2", str(error))
        raise EstimateError(said) from error


def _one_a_level(path: Path, responses: Sequence[FrequencyResponse]) -> list[Path]:
    """The path itself for one response, else one name each that tells which it is."""
    from samii_rig.report.facts import names

    if len(responses) == 1:
        return [path]
    words = (re.sub(r"[^\w.+-]+", "_", name).strip("_") for name in names(responses))
    return [path.with_name(f"{path.stem}_{word}{path.suffix}") for word in words]
