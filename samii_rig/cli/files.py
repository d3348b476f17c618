"""`samii-rig import`, `verify` and `recover`: recordings as files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from samii_rig.cli.common import JsonOption, Logs, say_json


def import_(
    files: Annotated[list[Path], typer.Argument(help="Foreign recordings.", show_default=False)],
    layout: Annotated[
        str, typer.Option("--map", help="Name of a shipped map, or the path of a map file.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the recordings.")] = Path("runs"),
    json: JsonOption = False,
) -> None:
    """Turn text, CSV, MAT and UFF 58 files into recordings, by a map of their columns.

    Missing samples stay missing. Nothing is written unless every file can be read.

    Example: samii-rig import recordings/*.txt --map sflr --out runs/sflr
    """
    from samii_rig.errors import InputError
    from samii_rig.record.importer import import_file
    from samii_rig.record.maps import load_map
    from samii_rig.record.store import write_recording

    the_map, text = load_map(layout)
    targets = [out / f"{path.stem}.mcap" for path in files]
    for path, target in zip(files, targets, strict=True):
        if target.exists():
            raise InputError(str(path), "", str(target), "no recording of that name yet")
    if len(set(targets)) < len(targets):
        raise InputError("FILES", "", [p.name for p in files], "files of different names")
    recordings = [import_file(path, the_map, text) for path in files]
    out.mkdir(parents=True, exist_ok=True)
    for recording, target in zip(recordings, targets, strict=True):
        write_recording(target, recording)
        if not json:
            lost = recording.stop.missing_samples
            typer.echo(
                f"{target}: {len(recording):,} samples of "
                f"{', '.join(c.name for c in recording.channels)}"
                + (f"; {lost} missing" if lost else "")
            )
    if json:
        say_json({"written": targets, "samples": [len(r) for r in recordings]})


def verify(logs: Logs, json: JsonOption = False) -> None:
    """Say what is in recordings, down to the last bit.

    Exit code 0: all whole; 3: something is lost or damaged; 1: a file with nothing in it.

    Example: samii-rig verify runs/*.mcap
    """
    from dataclasses import asdict

    from samii_rig.record.verify import verify as check

    found = [check(path) for path in logs]
    if json:
        say_json({"files": [asdict(v) for v in found]})
    else:
        for v in found:
            typer.echo(
                f"{v.path}: {v.status}; {v.samples:,} samples, {v.segments} segments, "
                f"{v.responses} frequency responses"
                + (f", {v.missing} samples missing in {v.gaps} gaps" if v.gaps else "")
                + (f"; {v.stop.status}: {v.stop.reason}" if v.stop else "; no stop record")
            )
            for problem in v.problems:
                typer.echo(f"  {problem}")
    codes = {v.exit_code for v in found}
    raise typer.Exit(1 if 1 in codes else max(codes))


def recover(
    logs: Logs,
    out: Annotated[
        Path | None, typer.Option(help="The new file [default: NAME.recovered.mcap]; for one log.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Give back every sample of a run that was cut off or damaged, as a whole new file.

    The damaged file is left as it is.

    Exit code 0: all that it held, though its end may be missing, as after a power cut;
    3: something in it was damaged or lost; 1: no sample and no result.

    Example: samii-rig recover runs/broken.mcap.partial
    """
    from dataclasses import asdict

    from samii_rig.errors import InputError
    from samii_rig.record.recover import recover as give_back

    if out and len(logs) > 1:
        raise InputError("--out", "", str(out), "one recording only")
    found = [give_back(path, out) for path in logs]
    if json:
        say_json({"files": [asdict(r) for r in found]})
    for r in () if json else found:
        typer.echo(
            f"{r.path}: {r.samples:,} samples, {r.segments} segments, {r.events} events, "
            f"{r.responses} frequency responses"
        )
        for problem in r.problems:
            typer.echo(f"  {problem}")
    codes = {r.exit_code for r in found}
    raise typer.Exit(1 if 1 in codes else max(codes))
