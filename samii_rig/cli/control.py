"""`samii-rig control`: a loop that damps vibration, from the model of a rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from samii_rig.cli.common import JsonOption, RigOption, say_json


def control(
    rig: RigOption = "samii",
    identified: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="What `samii-rig identify --json` printed (.json): its values and covariance "
            "take the place of the rig's; or another rig file (.toml), used instead.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for rig file, pictures, JSON.")] = Path(
        "control"
    ),
    sensor: Annotated[
        str | None, typer.Option(help="Accelerometer to feed back [default: the first]")
    ] = None,
    poles: Annotated[
        int | None,
        typer.Option(help="Poles of the low-pass [default: as few as suffice]", min=1, max=4),
    ] = None,
    spread: Annotated[
        float, typer.Option(help="Every stiffness may be off by this part.", min=0, max=0.9)
    ] = 0.2,
    draws: Annotated[int, typer.Option(help="Rigs drawn of each kind.", min=2, max=5000)] = 50,
    seed: Annotated[int, typer.Option(help="Of the draws.", min=0)] = 0,
    steps: Annotated[
        list[Path] | None,
        typer.Option(help="Recording of a step experiment to judge; may be repeated."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Design a loop that damps mode 1 by an accelerometer, with margins on every likely rig.

    Writes the rig file with the loop in it, to be run like any other. A rig that has a feedback
    already is judged, not designed.

    Example: samii-rig control --rig samii --out control
    """
    from samii_rig.cli.arguments import check_accelerometer, check_rig
    from samii_rig.files import check_folder, make_folder

    check_rig(rig)
    check_folder("--out", out)

    from samii_rig.rig.load import load_rig

    the_rig, text = load_rig(rig)
    if sensor is not None and identified is None:
        check_accelerometer(the_rig, sensor)

    from rich.console import Console

    from samii_rig.control.design import Goals, design
    from samii_rig.control.identified import identified as take_in
    from samii_rig.control.multiloop import line as together_line
    from samii_rig.control.multiloop import multiloop
    from samii_rig.control.multiloop import plain as together_plain
    from samii_rig.control.pictures import write_pictures
    from samii_rig.control.result import lines, plain, rig_text, step_line
    from samii_rig.control.settle import settling
    from samii_rig.record.reader import read_recording
    from samii_rig.report.summary import working

    known = None
    if identified is not None and identified.suffix == ".toml":
        the_rig, text = load_rig(str(identified))
    elif identified is not None:
        found = take_in(text, identified)
        the_rig, text, known = found.rig, found.text, found.known
    judged = any(f.actuator == the_rig.actuator[0].name for f in the_rig.feedback)
    recordings = [read_recording(path) for path in steps or ()]
    make_folder("--out", out)
    console = Console(highlight=False, soft_wrap=True)
    with working(Console(stderr=True, highlight=False), "control", quiet=json) as say:
        say("modes")
        made = design(
            the_rig,
            sensor=sensor,
            poles=poles,
            goals=Goals(spread=spread),
            draws=draws,
            seed=seed,
            known=known,
            progress=say,
        )
        shown = [settling(r, made.feedback.sensor) for r in recordings]
    stem = (identified or Path(rig)).stem
    target = out / f"{stem}_damped.toml"
    pictures = write_pictures(made, shown, out)
    data = plain(made, shown)
    together = multiloop(made.plant, made.rig)
    data["together"] = together_plain(together)
    if not judged:
        target.write_text(rig_text(text, made), encoding="utf-8")
        data["rig_file"] = str(target)
    data["pictures"] = [str(p) for p in pictures]
    import json as encoder

    (out / "control.json").write_text(encoder.dumps(data, indent=2), encoding="utf-8")
    if json:
        say_json(data)
        return
    for line in (*lines(made), *map(step_line, shown)):
        console.print(line)
    if together is not None:
        console.print(together_line(together))
