"""`samii-rig diagnose`: what physics a rig file leaves out, from recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer
from typer.core import TyperCommand

from samii_rig.cli.common import (
    JsonOption,
    SchedulerOption,
    WorkersOption,
    rig_of,
    say_json,
    without_rig,
)
from samii_rig.cli.estimate import (
    GAPS,
    BandOption,
    Estimating,
    GapsOption,
    OutputOption,
    PoseOption,
    RigOverride,
    read_all,
)
from samii_rig.cli.options import takes
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from concurrent.futures import Executor

    from rich.console import Console

    from samii_rig.diagnose.batch import How
    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.progress import Progress
    from samii_rig.record.reader import SavedResponses
    from samii_rig.rig.schema import Rig
    from samii_rig.rig.schema.pose import Angle
    from samii_rig.signal.gather import Gaps
    from samii_rig.types import FrequencyResponse, Recording


class Spread(TyperCommand):
    """A command whose --before and --after take all words up to the next option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """As of `click.Command`."""
        out: list[str] = []
        option = ""
        for word in args:
            if word.startswith("-"):
                option = word if word in ("--before", "--after") else ""
                out.append(word)
            elif option and out[-1] != option:
                out += [option, word]
            else:
                out.append(word)
        return super().parse_args(ctx, out)


@dataclass(frozen=True, kw_only=True)
class DiagnoseOptions:
    """Words of `samii-rig diagnose`."""

    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Recordings (.mcap), or responses that frf --save kept.", show_default=False
        ),
    ] = None
    rig: RigOverride = None
    before: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings of the state before a change, one or more."),
    ] = None
    after: Annotated[
        list[Path] | None, typer.Option(help="Recordings of the state after it, one or more.")
    ] = None
    known: Annotated[
        list[str] | None,
        typer.Option(
            help="ELEMENT.PARAMETER=VALUE of the rig file, known and exact; with --before, of the "
            "state after. May be repeated."
        ),
    ] = None
    known_before: Annotated[
        list[str] | None,
        typer.Option(help="The same of the state before alone. May be repeated."),
    ] = None
    pose: PoseOption = None
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the page (diagnosis.html), the new rig file (diagnosed.toml) and the "
            "diagnosis as data (diagnosis.json)."
        ),
    ] = None
    output: OutputOption = None
    gaps: GapsOption = "auto"
    band: BandOption = None
    each: Annotated[
        bool,
        typer.Option(
            "--each",
            help="Diagnose every recording by itself, a folder's too; --out gets a .json for each.",
        ),
    ] = False
    workers: WorkersOption = None
    scheduler: SchedulerOption = ""
    quiet: Annotated[
        bool, typer.Option("--quiet", help="Do not say what is being tried, the answer alone.")
    ] = False
    json: JsonOption = False


@takes(DiagnoseOptions)
def diagnose(o: DiagnoseOptions) -> None:
    """Locate what differs between rig file and recordings, name it, model it, show the gain.

    Says which explanations the data do not distinguish, and which experiment would. With --before
    and --after: what changed between two states of the rig. Recordings in several poses share one
    set of parameters.

    Example: samii-rig diagnose runs/*.mcap --rig samii --out diagnosis
    """
    logs, earlier = _checked(o)
    if o.each:
        _by_themselves(o, logs)
    else:
        _together(o, logs, earlier)


def _checked(o: DiagnoseOptions) -> tuple[list[Path], list[Path]]:
    """The recordings to be explained and those of the state before, once all is possible."""
    from samii_rig.cli.arguments import (
        check_band,
        check_channels,
        check_choice,
        check_known,
        check_logs,
        check_poses,
        check_rig,
    )

    check_rig(o.rig)
    check_choice("--gaps", o.gaps, GAPS)
    check_band(o.band)
    logs, earlier = _states(o)
    if o.pose and (earlier or o.each):
        what = "recordings of one state, diagnosed together: no --before, --after or --each"
        raise InputError("--pose", "", o.pose[0], what)
    if o.known_before and not earlier:
        raise InputError("--known-before", "", o.known_before[0], "--before and --after beside it")
    if not o.each:
        every = [*earlier, *logs]
        check_logs(every)
        check_known(o.known or (), "--known", o.rig, every)
        check_known(o.known_before or (), "--known-before", o.rig, every)
        check_poses(o.pose, o.rig, logs)
        check_channels("--output", o.output, every)

    from samii_rig.files import check_folder

    if o.out is not None:
        check_folder("--out", o.out)
    return logs, earlier


def _states(o: DiagnoseOptions) -> tuple[list[Path], list[Path]]:
    """The recordings to be explained, and those of the state before, none if there is one state."""
    logs, before, after = o.logs or [], o.before or [], o.after or []
    if bool(before) != bool(after):
        given, other = ("--before", "--after") if before else ("--after", "--before")
        raise InputError(given, "", str((before or after)[0]), f"{other} with recordings beside it")
    if before and logs:
        raise InputError("LOGS", "", str(logs[0]), "recordings of --before and --after alone")
    if o.each and (before or o.known or o.known_before):
        raise InputError("--each", "", True, "neither --before, --after nor --known beside it")
    if not (logs or after):
        none = "missing; expected recordings (.mcap), or --before and --after with theirs"
        raise InputError.saying("LOGS", "", none)
    twice = {p.resolve() for p in before} & {p.resolve() for p in after}
    if twice:
        raise InputError("--after", "", str(min(twice)), "other recordings than --before")
    return logs or after, before


@dataclass(frozen=True, slots=True)
class _Asked:
    """What is held against a rig file.

    first, second : recordings of the state before and of the one that is explained; or saved
    responses. rig, text : the file. at : the pose of each of `second`. in_pose : the rig in the
    first of them; own : with what is known put in. known, known_before : as the words say.
    """

    first: list[Recording]
    second: list[Recording]
    saved: list[SavedResponses]
    rig: Rig
    text: str
    at: list[Angle]
    in_pose: Rig
    own: Rig
    known: Mapping[str, float]
    known_before: Mapping[str, float]

    @property
    def plain(self) -> bool:
        """One state, as it was recorded, with the rig file as it is."""
        return not (self.first or self.known or self.saved)

    @property
    def kept(self) -> bool:
        """A change is no diagnosis of either state's recordings, nor is one of another rig."""
        from samii_rig.diagnose.posed import same_rig

        alike = (
            r.rig_toml in ("", self.text) or same_rig(r.rig_toml, self.rig) for r in self.second
        )
        return self.plain and all(alike)


def _asked(o: DiagnoseOptions, logs: list[Path], earlier: list[Path]) -> _Asked:
    """All of it, read."""
    from samii_rig.diagnose.fit.known import stated, with_known
    from samii_rig.diagnose.posed import one_pose
    from samii_rig.identify.poses import at_pose, poses_of

    known, before = stated(o.known or ()), stated(o.known_before or (), "--known-before")
    saved = _saved([*earlier, *logs], two=bool(earlier))
    first, second = ([], []) if saved else (read_all(earlier), read_all(logs))
    held = rig_of(saved or [*first, *second], o.rig)
    if held is None:
        raise without_rig()
    rig, text = held
    if saved and o.pose:
        what = "recordings: several poses are held against the model by their samples"
        raise InputError("LOGS", "", saved[0].source, what)
    at = poses_of(second, rig, o.pose or ())
    if first:
        every = [*poses_of(first, rig, ()), *at]
        at = [one_pose(every, "--before", "both states in one pose")]
    in_pose = at_pose(rig, at[0]) if at else rig
    own = with_known(in_pose, known)
    return _Asked(first, second, saved, rig, text, at, in_pose, own, known, before)


def _found(
    o: DiagnoseOptions, asked: _Asked, say: Progress
) -> tuple[Diagnosis, Sequence[FrequencyResponse]]:
    """The diagnosis, and the responses that a page shows."""
    from samii_rig.diagnose.changed import State, changed
    from samii_rig.diagnose.diagnose import diagnose as found_by
    from samii_rig.diagnose.posed import in_poses, of_any_kind, sorted_by_pose

    estimating = Estimating(output=o.output, gaps=o.gaps, band=o.band)

    def of(runs: Sequence[Recording]) -> Sequence[FrequencyResponse]:
        return estimating.of(of_any_kind(runs))

    say("frequency responses")
    if asked.saved:
        files = [(file.source, chosen(file, o.output)) for file in asked.saved]
        responses = [r for _, own in files for r in own]
        found = found_by(responses, asked.own, band=o.band, progress=say, files=files)
        return found, responses
    if asked.first:
        after = State(of(asked.second), asked.second)
        found = changed(
            State(of(asked.first), asked.first),
            after,
            asked.in_pose,
            known=asked.known,
            known_before=asked.known_before,
            band=o.band,
            progress=say,
        )
        return found, after.responses
    each = sorted_by_pose(asked.second, asked.at, of)
    return in_poses(each, asked.own, band=o.band, progress=say), each[0].responses


def _together(o: DiagnoseOptions, logs: list[Path], earlier: list[Path]) -> None:
    """One diagnosis of all recordings, said, kept and written."""
    from dataclasses import replace

    from rich.console import Console

    from samii_rig.report.summary import working

    asked = _asked(o, logs, earlier)
    console = Console(highlight=False)
    with working("diagnosis", quiet=o.json or o.quiet) as say:
        found, responses = _found(o, asked, say)
    if asked.kept:
        keep_diagnosis(logs, found)
    page = None
    if o.out is not None:
        from samii_rig.report.diagnosis.page import write_diagnosis

        found = replace(found, model=_write(o.out, found))
        page = write_diagnosis(
            o.out / "diagnosis.html",
            found,
            responses,
            asked.own,
            recordings=[*asked.first, *asked.second],
            band_hz=o.band or (0.0, float("inf")),
        )
    if o.json:
        say_json(found.plain())
        return
    for line in found.lines():
        console.print(line, soft_wrap=True)
    if found.model:
        console.print(f"written  {found.model}", soft_wrap=True)
    if page:
        console.print(f"page     {page}", soft_wrap=True)
    if asked.plain and not asked.kept:
        console.print("not kept with the recordings: they carry another rig file", soft_wrap=True)


def _saved(logs: list[Path], *, two: bool) -> list[SavedResponses]:
    """What `frf --save` kept, if that is what the files are. two : states are asked for."""
    from samii_rig.record.reader import read_saved_responses

    every = [read_saved_responses(path) for path in logs]
    saved = [file for file in every if file is not None]
    if saved and (two or len(saved) < len(every)):
        what = "recordings: two states are compared by their samples" if two else (
            "recordings alone, or files of `frf --save` alone"
        )  # fmt: skip
        raise InputError("LOGS", "", saved[0].source, what)
    return saved


def chosen(file: SavedResponses, output: list[str] | None) -> tuple[FrequencyResponse, ...]:
    """Saved responses of the outputs that are asked for; InputError names one that is not there."""
    from samii_rig.diagnose.data.wiring import outputs_of
    from samii_rig.errors import one_of

    if output is None:
        return file.responses
    every = list(dict.fromkeys(c.name for r in file.responses for c in r.outputs))
    for name in output:
        if name not in every:
            raise InputError(file.source, "--output", name, one_of(name, every))
    out = []
    for r in file.responses:  # a level may lack a sensor that was unsound there
        names = [c.name for c in r.outputs]
        if keep := [names.index(n) for n in output if n in names]:
            out.append(outputs_of(r, keep))
    return tuple(out)


def keep_diagnosis(logs: list[Path], found: Diagnosis) -> None:
    """Keep a diagnosis with its recordings, or say why that does not go."""
    _keep(logs, {**found.plain(), "lines": list(found.lines())})


def _keep(logs: list[Path], found: dict[str, Any]) -> None:
    """What was found, beside each recording, where `samii-rig recordings` finds it again."""
    from samii_rig.errors import RecordingError
    from samii_rig.index.remarks import set_diagnosis

    for path in logs:
        try:
            set_diagnosis(path, found)
        except RecordingError as error:
            # A folder that only lets itself be read is no reason to diagnose nothing.
            typer.echo(f"samii-rig: the diagnosis is not kept: {error}", err=True)


def _by_themselves(o: DiagnoseOptions, logs: list[Path]) -> None:
    """A diagnosis of each recording."""
    from rich.console import Console

    from samii_rig.diagnose.batch import How
    from samii_rig.files import make_folder
    from samii_rig.rig.load import load_rig
    from samii_rig.workers import workers as at_work

    text = load_rig(o.rig)[1] if o.rig else ""
    how = How(text, tuple(o.output) if o.output else None, cast("Gaps", o.gaps), o.band)
    if o.out is not None:
        make_folder("--out", o.out)
    with at_work(o.workers, o.scheduler) as executor:
        said = _each(logs, how, o.out, executor, Console(highlight=False, stderr=o.json))
    if o.json:
        say_json({"recordings": said})


def _each(
    given: list[Path], how: How, out: Path | None, executor: Executor, console: Console
) -> list[dict[str, Any]]:
    """A line for every recording, and a file in `out`; one that has no diagnosis says why."""
    import json

    from samii_rig.diagnose.batch import each

    logs = [log for p in given for log in (sorted(p.rglob("*.mcap")) if p.is_dir() else [p])]
    if not logs:
        raise InputError("LOGS", "", str(given[0]), "a folder with recordings (.mcap)")
    stems = [log.stem for log in logs]
    twice = [stem for stem in stems if stems.count(stem) > 1]
    if out is not None and twice:
        raise InputError("--out", "", twice[0], "recordings of different names")
    said = []
    for log, one in each(logs, executor, how):
        said.append({"recording": str(log), **one})
        if out is not None:
            (out / f"{log.stem}.json").write_text(json.dumps(one, indent=2), encoding="utf-8")
        if "error" not in one:
            _keep([log], one)
        what = f"no diagnosis: {one['error']}" if "error" in one else one["lines"][0]
        console.print(f"{log}  {what}", soft_wrap=True, markup=False)
    return said


def _write(folder: Path, found: Diagnosis) -> str:
    """Write the new rig file, if there is one, and the contract; the rig file's path."""
    import json
    from dataclasses import replace

    from samii_rig.diagnose.fit.rigfile import toml
    from samii_rig.files import make_folder

    make_folder("--out", folder)
    try:
        path = ""
        if found.rig is not None and (found.causes or found.exact):
            path = str(folder / "diagnosed.toml")
            Path(path).write_text(toml(found.rig), encoding="utf-8")
        plain = replace(found, model=path).plain()
        (folder / "diagnosis.json").write_text(json.dumps(plain, indent=2), encoding="utf-8")
    except OSError as error:
        raise InputError("--out", "", str(folder), f"a folder to write to ({error})") from error
    return path
