"""`samii-rig diagnose`: what physics a rig file leaves out, from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import JsonOption, Logs, rig_of, say_json
from samii_rig.cli.estimate import (
    BandOption,
    GapsOption,
    OutputOption,
    RigOverride,
    estimated,
    read_all,
)

if TYPE_CHECKING:
    from samii_rig.diagnose.result import Diagnosis


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
    json: JsonOption = False,
) -> None:
    """Locate what differs between rig file and recordings, name it, model it, show the gain.

    Says which explanations the data do not tell apart, and which experiment would.

    Example: samii-rig diagnose runs/*.mcap --rig samii --out diagnosis
    """
    from dataclasses import replace

    from rich.console import Console

    from samii_rig.diagnose.diagnose import diagnose as found_by
    from samii_rig.errors import InputError

    recordings = read_all(logs)
    held = rig_of(recordings, rig)
    if held is None:
        raise InputError("--rig", "", None, "a rig: these recordings carry none")
    console = Console(highlight=False, stderr=json)
    with console.status("frequency responses ...") as status:
        responses = estimated(recordings, None, output, "auto", gaps, band)
        found = found_by(
            responses,
            held[0],
            band=band,
            progress=lambda stage: status.update(f"{stage} ..."),
            runs=recordings,
        )
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


def _write(folder: Path, found: Diagnosis) -> str:
    """Write the new rig file, if there is one, and the contract; the rig file's path."""
    import json
    from dataclasses import replace

    from samii_rig.diagnose.rigfile import toml
    from samii_rig.errors import InputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = ""
        if found.rig is not None and found.causes:
            path = str(folder / "diagnosed.toml")
            Path(path).write_text(toml(found.rig), encoding="utf-8")
        plain = replace(found, model=path).plain()
        (folder / "diagnosis.json").write_text(json.dumps(plain, indent=2), encoding="utf-8")
    except OSError as error:
        raise InputError("--out", "", str(folder), f"a folder to write to ({error})") from error
    return path
