"""`samii-rig diagnose`: what physics a rig file leaves out, from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from samii_rig.cli.common import (
    JsonOption,
    Logs,
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
    RigOverride,
    estimated,
    read_all,
)

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from rich.console import Console

    from samii_rig.diagnose.batch import How
    from samii_rig.diagnose.result import Diagnosis
    from samii_rig.signal.gather import Gaps


def diagnose(
    logs: Logs,
    rig: RigOverride = None,
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

    Says which explanations the data do not tell apart, and which experiment would.

    Example: samii-rig diagnose runs/*.mcap --rig samii --out diagnosis
    """
    from samii_rig.cli.arguments import check_choice, check_logs, check_rig

    check_rig(rig)
    check_choice("--gaps", gaps, GAPS)
    if not each:
        check_logs(logs)

    from dataclasses import replace

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

    from samii_rig.diagnose.diagnose import diagnose as found_by
    from samii_rig.report.summary import working

    recordings = read_all(logs)
    held = rig_of(recordings, rig)
    if held is None:
        raise without_rig()
    console = Console(highlight=False)
    with working(console, "diagnosis", quiet=json) as say:
        say("frequency responses")
        responses = estimated(recordings, None, output, "auto", gaps, band)
        found = found_by(
            responses,
            held[0],
            band=band,
            progress=say,
            runs=recordings,
        )
    own = all(r.rig_toml in ("", held[1]) for r in recordings)
    if own:
        keep_diagnosis(logs, found)
    page = None
    if out is not None:
        from samii_rig.report.diagnosis import write_diagnosis

        found = replace(found, model=_write(out, found))
        page = write_diagnosis(
            out / "diagnosis.html",
            found,
            responses,
            held[0],
            recordings=recordings,
            band_hz=band or (0.0, float("inf")),
        )
    if json:
        say_json(found.plain())
        return
    for line in found.lines():
        console.print(line, soft_wrap=True)
    if found.model:
        console.print(f"written  {found.model}", soft_wrap=True)
    if page:
        console.print(f"page     {page}", soft_wrap=True)
    if not own:
        console.print("not kept with the recordings: they carry another rig file", soft_wrap=True)


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
    from samii_rig.errors import InputError

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

    from samii_rig.diagnose.rigfile import toml
    from samii_rig.errors import InputError
    from samii_rig.files import make_folder

    make_folder("--out", folder)
    try:
        path = ""
        if found.rig is not None and found.causes:
            path = str(folder / "diagnosed.toml")
            Path(path).write_text(toml(found.rig), encoding="utf-8")
        plain = replace(found, model=path).plain()
        (folder / "diagnosis.json").write_text(json.dumps(plain, indent=2), encoding="utf-8")
    except OSError as error:
        raise InputError("--out", "", str(folder), f"a folder to write to ({error})") from error
    return path
