"""`samii-rig import`, `verify` and `recover`: recordings as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import SAMPLES, JsonOption, Logs, check_target, say_json
from samii_rig.units import pretty

if TYPE_CHECKING:
    from samii_rig.record.describe import Description

if TYPE_CHECKING:
    from collections.abc import Iterable

    from samii_rig.record.verify import Verdict
    from samii_rig.types import Recording


def import_(
    files: Annotated[list[Path], typer.Argument(help="Foreign recordings.", show_default=False)],
    layout: Annotated[
        str, typer.Option("--map", help="Name of a shipped map, or the path of a map file.")
    ] = "",
    channels: Annotated[
        Path | None,
        typer.Option(help="Table of the sensors (CSV): sensitivity, direction, serial number, ..."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recordings.")] = Path("runs"),
    describe: Annotated[
        bool, typer.Option("--describe", help="Say what is in the files, and import nothing.")
    ] = False,
    write_map: Annotated[
        Path | None,
        typer.Option(help="Write a first map of one file to this place, and import nothing."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Turn text, CSV, MAT, UFF 58, JSON and Parquet files into recordings, by a map of their
    columns.

    Missing samples stay missing. Nothing is written unless every file can be read.

    Example: samii-rig import --describe run.csv --write-map lab.toml

    Example: samii-rig import recordings/*.txt --map sflr --out runs/sflr
    """
    from samii_rig.cli.arguments import check_logs, check_map
    from samii_rig.files import check_folder, make_folder

    check_map(layout)
    check_logs(files)
    if layout:
        check_folder("--out", out)

    from samii_rig.record.store import write_recording

    if describe or write_map:
        _describe(files, write_map, json=json)
        return
    targets = _targets(files, layout, out)
    recordings = _imported(files, layout, channels)
    make_folder("--out", out)
    for recording, target in zip(recordings, targets, strict=True):
        write_recording(target, recording)
        if not json:
            typer.echo(f"{target}: {_held(recording)}")
    if json:
        say_json({"written": targets, "samples": [len(r) for r in recordings]})


def _targets(files: list[Path], layout: str, out: Path) -> list[Path]:
    """Where the recordings will be; InputError without a map, or where one is already."""
    from samii_rig.errors import InputError
    from samii_rig.record.maps import shipped_maps

    if not layout:
        said = (
            f"missing; expected a map file or one of {', '.join(shipped_maps())}; "
            "--describe says what a file holds and writes a first one"
        )
        raise InputError.saying("--map", "", said)
    targets = [out / f"{path.stem}.mcap" for path in files]
    for path, target in zip(files, targets, strict=True):
        if target.exists():
            said = (
                f"there is a recording of that name already, {target}; delete it, or name another "
                "folder with --out"
            )
            raise InputError.saying(str(path), "", said)
    if len(set(targets)) < len(targets):
        raise InputError("FILES", "", [p.name for p in files], "files of different names")
    return targets


def _imported(files: list[Path], layout: str, channels: Path | None) -> list[Recording]:
    """The files as recordings, by a map and a table of the sensors."""
    from samii_rig.record.channel_table import load_channels
    from samii_rig.record.importer import import_file
    from samii_rig.record.maps import load_map

    the_map, text = load_map(layout)
    table = load_channels(channels) if channels else None
    return [import_file(path, the_map, text, table) for path in files]


def _held(recording: Recording) -> str:
    """What is in a recording, in a line."""
    lost, segments = recording.stop.missing_samples, len(recording.segments)
    return (
        f"{len(recording):,} samples of {', '.join(c.name for c in recording.channels)}"
        + (f"; {segments} segments" if segments > 1 else "")
        + (f"; {lost} missing" if lost else "")
    )


def _describe(files: list[Path], write_map: Path | None, *, json: bool) -> None:
    """Say what is in foreign files, and write a first map of the only one."""
    from samii_rig.errors import InputError
    from samii_rig.files import check_file
    from samii_rig.record.describe import describe
    from samii_rig.record.export import replacing
    from samii_rig.record.first_map import first_map

    if write_map is not None:
        if len(files) > 1:
            raise InputError("--write-map", "", str(write_map), "one file to describe")
        if write_map.exists():
            raise InputError("--write-map", "", str(write_map), "the name of a new file")
        check_file("--write-map", write_map)
    found = [describe(path) for path in files]
    if write_map is not None:
        with replacing(write_map) as part:
            part.write_text(first_map(found[0]), encoding="utf-8")
    if json:
        say_json({"files": [_described(d) for d in found]})
        return
    for d in found:
        for line in d.lines():
            typer.echo(line)
    if write_map is not None:
        typer.echo(f"{write_map}: a first map; samii-rig import {files[0]} --map {write_map}")


def _described(found: Description) -> dict[str, object]:
    """A description as plain data."""
    from dataclasses import asdict

    return {**asdict(found), "format": found.format.model_dump()}


def export(
    log: Annotated[Path, typer.Argument(help="A recording (.mcap).", show_default=False)],
    out: Annotated[
        Path,
        typer.Option(
            help="The new file: .csv, .parquet, .mat, .wav or .uff; replaced if it exists."
        ),
    ],
    json: JsonOption = False,
) -> None:
    """Write the samples of a recording for other programs, with their units.

    WAV and UFF 58 have one step in time and take no recording with gaps.

    Example: samii-rig export runs/run.mcap --out run.csv
    """
    from samii_rig.cli.arguments import check_logs

    check_logs([log])
    check_target("--out", out, SAMPLES, [log])

    from samii_rig.record.export_samples import check_suffix, export_samples
    from samii_rig.record.reader import read_recording

    check_suffix(out)
    recording = read_recording(log)
    export_samples(out, recording)
    if json:
        say_json({"written": out, "samples": len(recording)})
    else:
        names = ", ".join(c.name for c in recording.channels)
        typer.echo(f"{out}: {len(recording):,} samples of {names}")


def verify(logs: Logs, json: JsonOption = False) -> None:
    """Say what is in recordings, down to the last bit.

    Exit code 0: all whole; 3: something is lost or damaged; 1: a file with nothing in it;
    2: a file that is no MCAP file. What a file costs is bounded by its size: one that unpacks to
    more than a run can hold is looked at up to there.

    Example: samii-rig verify runs/*.mcap
    """
    from samii_rig.cli.arguments import check_logs

    check_logs(logs)

    from dataclasses import asdict

    from samii_rig.record.verify import verify as check

    found = [check(path) for path in logs]
    if json:
        say_json({"files": [asdict(v) for v in found]})
    else:
        for v in found:
            typer.echo(_verdict(v))
            for problem in v.problems:
                typer.echo(f"  {problem}")
            if v.status == "lossy":
                typer.echo(f"  samii-rig recover {v.path} gives back what is whole")
    raise typer.Exit(_worst(v.exit_code for v in found))


def _verdict(v: Verdict) -> str:
    if v.status == "foreign":
        return f"{v.path}: not a recording"
    return (
        f"{v.path}: {v.status}; {v.samples:,} samples, {v.segments} segments, "
        f"{v.responses} frequency responses"
        + (f", {v.missing} samples missing in {v.gaps} gaps" if v.gaps else "")
        + (f"; {v.stop.status}: {pretty(v.stop.reason)}" if v.stop else "; no stop record")
    )


def _worst(codes: Iterable[int]) -> int:
    """The exit code for several files: no recording, nothing in it, damaged, whole."""
    return min(codes, key=(2, 1, 3, 0).index)


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
    from samii_rig.cli.arguments import check_logs
    from samii_rig.errors import InputError
    from samii_rig.files import check_file

    check_logs(logs)
    if out:
        if len(logs) > 1:
            raise InputError("--out", "", str(out), "one recording only")
        check_file("--out", out)

    from dataclasses import asdict

    from samii_rig.record.recover import recover as give_back

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
    raise typer.Exit(_worst(r.exit_code for r in found))
