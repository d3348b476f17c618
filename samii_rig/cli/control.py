"""`samii-rig control`: a loop that damps vibration, from the model of a rig."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from samii_rig.cli.common import JsonOption, RigOption, say_json
from samii_rig.cli.options import takes

if TYPE_CHECKING:
    from samii_rig.control.design import Design
    from samii_rig.control.multiloop import Multiloop
    from samii_rig.control.settle import Settling
    from samii_rig.rig.schema import Rig


@dataclass(frozen=True, kw_only=True)
class ControlOptions:
    """Words of `samii-rig control`."""

    rig: RigOption = "samii"
    identified: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="What `samii-rig identify --json` printed (.json): its values and covariance "
            "take the place of the rig's; or another rig file (.toml), used instead.",
        ),
    ] = None
    out: Annotated[Path, typer.Option(help="Folder for rig file, pictures, JSON.")] = Path(
        "control"
    )
    sensor: Annotated[
        str | None, typer.Option(help="Accelerometer to feed back [default: the first]")
    ] = None
    poles: Annotated[
        int | None,
        typer.Option(help="Poles of the low-pass [default: as few as suffice]", min=1, max=4),
    ] = None
    spread: Annotated[
        float, typer.Option(help="Every stiffness may be off by this part.", min=0, max=0.9)
    ] = 0.2
    draws: Annotated[int, typer.Option(help="Rigs drawn of each kind.", min=2, max=5000)] = 50
    seed: Annotated[int, typer.Option(help="Of the draws.", min=0)] = 0
    steps: Annotated[
        list[Path] | None,
        typer.Option(help="Recording of a step experiment to judge; may be repeated."),
    ] = None
    json: JsonOption = False


@takes(ControlOptions)
def control(o: ControlOptions) -> None:
    """Design a loop that damps mode 1 by an accelerometer, with margins on every likely rig.

    Writes the rig file with the loop in it, to be run like any other. A rig that has a feedback
    already is judged, not designed.

    Example: samii-rig control --rig samii --out control
    """
    from samii_rig.cli.arguments import check_accelerometer, check_rig
    from samii_rig.files import check_folder

    check_rig(o.rig)
    check_folder("--out", o.out)

    from samii_rig.rig.load import load_rig

    rig, text = load_rig(o.rig)
    if o.sensor is not None and o.identified is None:
        check_accelerometer(rig, o.sensor)

    from rich.console import Console

    from samii_rig.control.multiloop import line as together_line
    from samii_rig.control.multiloop import multiloop
    from samii_rig.control.result import lines, step_line

    text, made, shown = _designed(o, rig, text)
    together = multiloop(made.plant, made.rig)
    data = _written(o, text, made, shown, together)
    if o.json:
        say_json(data)
        return
    console = Console(highlight=False, soft_wrap=True)
    for line in (*lines(made), *map(step_line, shown)):
        console.print(line)
    if together is not None:
        console.print(together_line(together))


def _designed(o: ControlOptions, rig: Rig, text: str) -> tuple[str, Design, list[Settling]]:
    """The rig file that a loop is put in, "" where one was judged; it; what each recording
    shows of it."""
    from samii_rig.control.design import Draws, Goals, design
    from samii_rig.control.identified import identified as take_in
    from samii_rig.control.settle import settling
    from samii_rig.files import make_folder
    from samii_rig.record.reader import read_recording
    from samii_rig.report.summary import working
    from samii_rig.rig.load import load_rig

    known = None
    if o.identified is not None and o.identified.suffix == ".toml":
        rig, text = load_rig(str(o.identified))
    elif o.identified is not None:
        found = take_in(text, o.identified)
        rig, text, known = found.rig, found.text, found.known
    recordings = [read_recording(path) for path in o.steps or ()]
    make_folder("--out", o.out)
    with working("control", quiet=o.json) as say:
        say("modes")
        made = design(
            rig,
            sensor=o.sensor,
            poles=o.poles,
            goals=Goals(spread=o.spread),
            draws=Draws(o.draws, o.seed, known),
            progress=say,
        )
        shown = [settling(r, made.feedback.sensor) for r in recordings]
    judged = any(f.actuator == rig.actuator[0].name for f in rig.feedback)
    return "" if judged else text, made, shown


def _written(
    o: ControlOptions, text: str, made: Design, shown: list[Settling], together: Multiloop | None
) -> dict[str, Any]:
    """The folder, and the same as data. text : the rig file that a loop is put in, "" for none."""
    import json

    from samii_rig.control.multiloop import plain as together_plain
    from samii_rig.control.pictures import write_pictures
    from samii_rig.control.result import plain, rig_text

    pictures = write_pictures(made, shown, o.out)
    data = plain(made, shown)
    data["together"] = together_plain(together)
    if text:
        target = o.out / f"{(o.identified or Path(o.rig)).stem}_damped.toml"
        target.write_text(rig_text(text, made), encoding="utf-8")
        data["rig_file"] = str(target)
    data["pictures"] = [str(p) for p in pictures]
    (o.out / "control.json").write_text(json.dumps(data, indent=2), encoding="utf-8")
    return data
