"""`samii-rig diagnose`: what physics a rig file leaves out, from recordings."""

from __future__ import annotations

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
    GapsOption,
    OutputOption,
    PoseOption,
    RigOverride,
    estimated,
    read_all,
)
from samii_rig.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from concurrent.futures import Executor

    from rich.console import Console

    from samii_rig.diagnose.batch import How
    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.record.reader import SavedResponses
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


def diagnose(
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Recordings (.mcap), or responses that frf --save kept.", show_default=False
        ),
    ] = None,
    rig: RigOverride = None,
    before: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings of the state before a change, one or more."),
    ] = None,
    after: Annotated[
        list[Path] | None, typer.Option(help="Recordings of the state after it, one or more.")
    ] = None,
    known: Annotated[
        list[str] | None,
        typer.Option(
            help="ELEMENT.PARAMETER=VALUE of the rig file, known and exact; with --before, of the "
            "state after. May be repeated."
        ),
    ] = None,
    known_before: Annotated[
        list[str] | None,
        typer.Option(help="The same of the state before alone. May be repeated."),
    ] = None,
    pose: PoseOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the page (diagnosis.html), the new rig file (diagnosed.toml) and the "
            "diagnosis as data (diagnosis.json)."
        ),
    ] = None,
    output: OutputOption = None,
    gaps: GapsOption = "exclude",
    band: BandOption = None,
    each: Annotated[
        bool,
        typer.Option(
            "--each",
            help="Diagnose every recording by itself, a folder's too; --out gets a .json for each.",
        ),
    ] = False,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = "",
    json: JsonOption = False,
) -> None:
    """Locate what differs between rig file and recordings, name it, model it, show the gain.

    Says which explanations the data do not tell apart, and which experiment would. With --before
    and --after: what changed between two states of the rig. Recordings in several poses share one
    set of parameters.

    Example: samii-rig diagnose runs/*.mcap --rig samii --out diagnosis
    """
    from samii_rig.cli.arguments import (
        check_band,
        check_channels,
        check_choice,
        check_known,
        check_logs,
        check_poses,
        check_rig,
    )

    check_rig(rig)
    check_choice("--gaps", gaps, GAPS)
    check_band(band)
    any_known = bool(known or known_before)
    logs, earlier = _states(logs or [], before or [], after or [], each=each, known=any_known)
    if pose and (earlier or each):
        what = "recordings of one state, diagnosed together: no --before, --after or --each"
        raise InputError("--pose", "", pose[0], what)
    if known_before and not earlier:
        raise InputError("--known-before", "", known_before[0], "--before and --after beside it")
    if not each:
        check_logs([*earlier, *logs])
        check_known(known or (), "--known", rig, [*earlier, *logs])
        check_known(known_before or (), "--known-before", rig, [*earlier, *logs])
        check_poses(pose, rig, logs)
        check_channels("--output", output, [*earlier, *logs])

    from rich.console import Console

    from samii_rig.files import check_folder, make_folder

    if out is not None:
        check_folder("--out", out)
    if each:
        from samii_rig.diagnose.batch import How
        from samii_rig.rig.load import load_rig
        from samii_rig.workers import workers as at_work

        how = How(
            load_rig(rig)[1] if rig else "",
            tuple(output) if output else None,
            cast("Gaps", gaps),
            band,
        )
        if out is not None:
            make_folder("--out", out)
        with at_work(workers, scheduler) as executor:
            said = _each(logs, how, out, executor, Console(highlight=False, stderr=json))
        if json:
            say_json({"recordings": said})
        return
    stated = (tuple(known or ()), tuple(known_before or ()))
    how_ = (output, gaps, band)
    _together(logs, earlier, rig, stated, how_, out, poses=pose or (), json=json)


def _states(
    logs: list[Path], before: list[Path], after: list[Path], *, each: bool, known: bool
) -> tuple[list[Path], list[Path]]:
    """The recordings to be explained, and those of the state before, none if there is one state."""
    if bool(before) != bool(after):
        given, other = ("--before", "--after") if before else ("--after", "--before")
        raise InputError(given, "", str((before or after)[0]), f"{other} with recordings beside it")
    if before and logs:
        raise InputError("LOGS", "", str(logs[0]), "recordings of --before and --after alone")
    if each and (before or known):
        raise InputError("--each", "", True, "neither --before, --after nor --known beside it")
    if not (logs or after):
        none = "missing; expected recordings (.mcap), or --before and --after with theirs"
        raise InputError.saying("LOGS", "", none)
    twice = {p.resolve() for p in before} & {p.resolve() for p in after}
    if twice:
        raise InputError("--after", "", str(min(twice)), "other recordings than --before")
    return logs or after, before


def _together(
    logs: list[Path],
    earlier: list[Path],
    rig: str | None,
    known: tuple[tuple[str, ...], tuple[str, ...]],
    how: tuple[list[str] | None, str, tuple[float, float] | None],
    out: Path | None,
    *,
    poses: Sequence[str],
    json: bool,
) -> None:
    """One diagnosis of all recordings, said, kept and written. earlier : of the state before;
    known : words of --known and --known-before; poses : words of --pose."""
    from dataclasses import replace

    from rich.console import Console

    from samii_rig.diagnose.changed import State, changed
    from samii_rig.diagnose.diagnose import diagnose as found_by
    from samii_rig.diagnose.fit.exact import lengths
    from samii_rig.diagnose.fit.known import stated, with_known
    from samii_rig.diagnose.posed import in_poses, one_pose, same_rig, sorted_by_pose
    from samii_rig.identify.poses import at_pose, poses_of
    from samii_rig.report.summary import working

    output, gaps, band = how
    values, values_before = stated(known[0]), stated(known[1], "--known-before")
    saved = _saved([*earlier, *logs], two=bool(earlier))
    first, second = ([], []) if saved else (read_all(earlier), read_all(logs))
    held = rig_of(saved or [*first, *second], rig)
    if held is None:
        raise without_rig()
    if saved and poses:
        what = "recordings: several poses are held against the model by their samples"
        raise InputError("LOGS", "", saved[0].source, what)
    at = poses_of(second, held[0], poses)
    if first:
        every = [*poses_of(first, held[0], ()), *at]
        at = [one_pose(every, "--before", "both states in one pose")]
    the_rig = at_pose(held[0], at[0]) if at else held[0]
    own_rig = with_known(the_rig, values)
    console = Console(highlight=False)

    def of(runs: Sequence[Recording]) -> Sequence[FrequencyResponse]:
        return estimated(list(runs), None, output, "auto", gaps, band)

    with working(console, "diagnosis", quiet=json) as say:
        say("frequency responses")
        if saved:
            files = [(file.source, chosen(file, output)) for file in saved]
            responses: Sequence[FrequencyResponse] = [r for _, own in files for r in own]
            found = found_by(responses, own_rig, band=band, progress=say, files=files)
        elif first:
            responses = of(second)
            found = changed(
                State(of(first), first),
                State(responses, second),
                the_rig,
                known=values,
                known_before=values_before,
                band=band,
                progress=say,
            )
        else:
            each = sorted_by_pose(second, at, of)
            responses = each[0].responses
            found = in_poses(each, own_rig, band=band, progress=say)
    # A change is no diagnosis of either state's recordings, nor is one of another rig.
    alike = all(r.rig_toml in ("", held[1]) or same_rig(r.rig_toml, held[0]) for r in second)
    own = not (first or values or saved) and alike
    if own:
        keep_diagnosis(logs, found)
    page = None
    if out is not None:
        from samii_rig.report.diagnosis.page import write_diagnosis

        found = replace(found, model=_write(out, found))
        page = write_diagnosis(
            out / "diagnosis.html",
            found,
            responses,
            own_rig,
            recordings=[*first, *second],
            band_hz=band or (0.0, float("inf")),
        )
    if json:
        say_json(found.plain())
        return
    for line in found.lines():
        console.print(line, soft_wrap=True)
    apart = first or found.states or found.exact
    if found.verdict == "unknown" and not apart and (exact := lengths(own_rig)):
        console.print(
            f"exact    The rig file gives {', '.join(exact)} no tolerance. If one may be wrong, "
            f"free it: samii-rig identify with the same recordings, --rig and --free {exact[0]}",
            soft_wrap=True,
        )
    if found.model:
        console.print(f"written  {found.model}", soft_wrap=True)
    if page:
        console.print(f"page     {page}", soft_wrap=True)
    if not (own or first or values or saved):
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
    out = []
    for r in file.responses:
        names = [c.name for c in r.outputs]
        for name in output:
            if name not in names:
                raise InputError(file.source, "--output", name, one_of(name, names))
        out.append(outputs_of(r, [names.index(n) for n in output]))
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
