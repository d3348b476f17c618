"""`samii-rig devices`, `doctor`, `jog`, `calibrate`, `clear-fault`: work at the bench."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from samii_rig.cli.common import JsonOption, RigOption, say_json
from samii_rig.units import pretty

if TYPE_CHECKING:
    from samii_rig.rig.schema import Rig

# As of `run.session`, which takes a second to import; a test holds them together.
FASTEST, FURTHEST = 0.2, 0.8
EXIT = {"completed": 0, "stopped": 130, "tripped": 5, "failed": 6}
OutOption = Annotated[Path, typer.Option("--out", help="Folder of the recordings.")]


def devices(rig: RigOption = "samii", json: JsonOption = False) -> None:
    """Say which drivers and ports there are, and what answers at the rig's own device.

    Nothing moves; opening a device leaves its output at zero.

    Example: samii-rig devices --rig my_rig.toml
    """
    from samii_rig.cli.arguments import check_rig

    check_rig(rig)

    from samii_rig.devices.opening import drivers
    from samii_rig.errors import SamiiRigError
    from samii_rig.rig.load import load_rig
    from samii_rig.run.session import opened
    from samii_rig.safety.latch import Latch

    the_rig, _ = load_rig(rig)
    ports = _ports()
    fault = Latch(the_rig.name, the_rig.device.driver).fault
    found: dict[str, object] = {
        "drivers": sorted(drivers()),
        "ports": ports,
        "rig": the_rig.name,
        "driver": the_rig.device.driver,
        "fault": asdict(fault) if fault else None,
    }
    try:
        with opened(the_rig) as device:
            found |= {**device.metadata, "device": device.description, "state": "at zero"}
    except SamiiRigError as error:
        found["device"] = f"not open: {error}"
    if json:
        say_json(found)
        return
    typer.echo(f"drivers    {', '.join(sorted(drivers()))}")
    for i, port in enumerate(ports or ["none"]):
        typer.echo(f"{'' if i else 'ports':10} {port}")
    typer.echo(f"rig        {the_rig.name}, driver {the_rig.device.driver}")
    typer.echo(f"device     {found['device']}")
    for key in ("firmware", "serial", "boot", "state"):
        if key in found:
            typer.echo(f"{key:10} {found[key]}")
    if fault:
        typer.echo(f"FAULT      since {fault.time}: {pretty(fault.reason)}")


def _ports() -> list[str]:
    from serial.tools import list_ports

    found = sorted(list_ports.comports(), key=lambda p: p.device)
    return [f"{p.device}  {p.description}".removesuffix("  n/a") for p in found]


def doctor(
    rig: RigOption = "samii",
    out: OutOption = Path("runs"),
    move: Annotated[
        bool, typer.Option("--move", help="Push the joint a little to see the encoder's sign.")
    ] = False,
    protections: Annotated[
        bool,
        typer.Option(
            "--protections",
            help="Try the device's deadman, emergency input and reset, the valve unplugged.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Look at machine, disk, device and sensors; say the remedy of what is wrong.

    Exit code 6 if anything is bad. With --move the joint turns a little, through the gate. With
    --protections the output stays at null, but the device's supply line goes on for its deadman's
    time; a person is asked to open the emergency input and to reset the device.

    Example: samii-rig doctor --rig my_rig.toml --move
    """
    from samii_rig.cli.arguments import check_rig
    from samii_rig.files import check_folder

    check_rig(rig)
    if move:
        check_folder("--out", out)

    from samii_rig.rig.load import load_rig
    from samii_rig.run.doctor import examine

    the_rig, text = load_rig(rig)
    checks = []

    def ask(what: str) -> None:
        typer.echo(f"->    {what}", err=json)

    asks = ask if protections else None
    for check in examine(the_rig, text, out, move=move, protections=asks):
        checks.append(check)
        if not json:
            typer.echo(
                f"{check.verdict.upper() if check.verdict == 'bad' else check.verdict:5} "
                f"{check.what:14} {pretty(check.found)}"
            )
            if check.remedy:
                typer.echo(f"{'':20} -> {pretty(check.remedy)}")
    bad = [c.what for c in checks if c.verdict == "bad"]
    if json:
        say_json({"good": not bad, "checks": [asdict(c) for c in checks]})
    raise typer.Exit(6 if bad else 0)


def jog(
    to: Annotated[
        float, typer.Option("--to", help="Angle to bring the joint to, in its sensor's unit.")
    ] = 0.0,
    speed: Annotated[float, typer.Option(help="Mean speed, unit/s; at most 0.2.")] = 0.05,
    rig: RigOption = "samii",
    out: OutOption = Path("runs"),
    json: JsonOption = False,
) -> None:
    """Bring the joint slowly to an angle, through the gate; recorded like a run.

    Exit code 6 if it ends further from there than 2 % of the way.

    Example: samii-rig jog --to 0.05 --rig my_rig.toml
    """
    from samii_rig.cli.arguments import check_rig
    from samii_rig.files import check_folder

    check_rig(rig)
    check_folder("--out", out)

    from samii_rig.errors import InputError
    from samii_rig.rig.load import load_rig

    the_rig, text = load_rig(rig)
    if (loop := the_rig.centring) is not None:
        unit = the_rig.units()[loop.sensor]
        most = min((x.max for x in the_rig.limits_on(loop.sensor)), default=float("inf"))
        if not abs(to) <= FURTHEST * most:
            what = f"at most {FURTHEST * most:.3g} {unit}: 80 % of {loop.sensor}'s limit"
            raise InputError("jog", "--to", to, what)
        if not 0.0 < speed <= FASTEST:
            what = f"above 0 and at most {FASTEST:g} {unit}/s"
            raise InputError("jog", "--speed", speed, what)

    from samii_rig.run.session import jog as go

    move = go(the_rig, text, to, speed, out)
    code = EXIT.get(move.stop.status, 1)
    if code == 0 and not move.reached:
        code = EXIT["failed"]
    if json:
        say_json({**asdict(move), "reached": move.reached, "recording": str(move.recording)})
    else:
        unit, status = pretty(move.unit), move.stop.status
        ended = "NOT REACHED" if status == "completed" and not move.reached else status
        way = f"{move.before:.4f} {unit} -> {move.after:.4f} {unit}"
        typer.echo(
            f"{ended}: {way}; asked for {move.to:.4f} {unit} within {move.within:.2g} {unit}"
        )
        if status != "completed":
            typer.echo(pretty(move.stop.reason))
        typer.echo(f"recording  {move.recording}")
    raise typer.Exit(code)


def calibrate(
    sensor: Annotated[str, typer.Argument(help="An input of the rig's device, or `null`.")],
    to: Annotated[Path, typer.Option("--to", help="The copy of the rig file to write (.toml).")],
    rig: RigOption,
    reads: Annotated[
        list[float] | None,
        typer.Option(help="The true value, once for the offset, twice for gain and offset."),
    ] = None,
    actuator: Annotated[
        str, typer.Option(help="Whose null is sought [default: the first of the rig file].")
    ] = "",
    seconds: Annotated[float, typer.Option(help="Of each measurement.", min=0.1, max=60.0)] = 2.0,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask; the rig is as it is said.")
    ] = False,
    out: OutOption = Path("runs"),
) -> None:
    """Find offset, or gain and offset, of an input, or the valve's null; write a copy of the file.

    For a sensor the rig is brought by hand to each value of --reads (0 without it). `null` lets
    the output live at zero, the loop open, and finds the counts at which the joint stands still.

    Example: samii-rig calibrate a_0 --reads 9.81 --reads -9.81 --rig my_rig.toml --to new.toml
    """
    from samii_rig.cli.arguments import check_rig
    from samii_rig.cli.common import check_target
    from samii_rig.errors import InputError
    from samii_rig.files import check_folder

    check_rig(rig)
    check_target("--to", to, (".toml",), [Path(rig)])
    if to.exists():
        raise InputError("calibrate", "--to", str(to), "a new name")
    check_folder("--out", out)

    from samii_rig.record.export import replacing
    from samii_rig.rig.load import load_rig

    the_rig, text = load_rig(rig)
    if sensor == "null":
        new_text, said = _null(the_rig, text, rig, seconds, out, actuator)
    else:
        known = reads or [0.0]
        new_text, said = _input(the_rig, text, rig, sensor, known, seconds, ask=not yes)
    with replacing(to) as part:
        part.write_text(new_text, encoding="utf-8")
    typer.echo(said)
    typer.echo(f"written    {to}")


def _input(
    rig: Rig, text: str, where: str, sensor: str, known: list[float], seconds: float, *, ask: bool
) -> tuple[str, str]:
    """The rig file's text with an input's offset, or gain and offset; and in words.

    known : the true values to which the rig is brought by hand, one or two.
    """
    import numpy as np

    from samii_rig.errors import InputError
    from samii_rig.run import calibrate as c

    old = c.wiring(rig, sensor)
    if len(known) > 2:
        raise InputError("calibrate", "--reads", known, "one or two values")

    from samii_rig.run.session import column, listen, opened

    unit = rig.units()[sensor]
    read = []
    for value in known:
        if ask:
            typer.confirm(f"{sensor} is at {value:g} {unit}, and still?", abort=True, err=True)
        with opened(rig) as device:
            read.append(float(np.mean(column(listen(device, seconds), sensor))))
    if len(known) == 1:
        new = c.one_point(old, read[0], known[0])
    else:
        new = c.two_points(old, (read[0], read[1]), (known[0], known[1]))
    said = (
        f"{sensor} read {', '.join(f'{x:.5g}' for x in read)} {unit}; counts_per_unit "
        f"{old.counts_per_unit:.8g} -> {new.counts_per_unit:.8g}, "
        f"offset {old.offset} -> {new.offset}"
    )
    return c.rewritten(text, where, sensor, new), said


def _null(
    rig: Rig, text: str, where: str, seconds: float, out: Path, actuator: str
) -> tuple[str, str]:
    from samii_rig.errors import DeviceError, InputError
    from samii_rig.record.reader import read_recording
    from samii_rig.run import calibrate as c
    from samii_rig.run.session import still
    from samii_rig.safety.limits import find_actuator, gate_limits

    spec = find_actuator(rig, actuator or rig.actuator[0].name, "calibrate")
    name, loop = spec.name, rig.centring_of(spec.name)
    if loop is None:
        raise InputError(rig.name, "centring", None, "a sensor that shows the joint standing still")
    sensor = loop.sensor
    beside = tuple(a.name for a in rig.actuator if a.name != name)
    turning = gate_limits(rig, name, loop.kp, sensor, beside=beside).turning
    if turning == 0.0:
        raise InputError(rig.name, "null", sensor, f"an angle whose speed follows from {name}")
    settings = rig.device.settings
    own = settings.get("output", {}).get(name)  # its line in a table of several
    per_unit = float(own["counts_per_unit"] if own else settings.get("output_counts_per_unit", 0.0))
    move = still(rig, text, seconds, out, name)
    if move.stop.status != "completed":
        raise DeviceError(f"{move.stop.status}: {move.stop.reason}")
    recording = read_recording(move.recording)
    segment = recording.cut(recording.segments[0])
    theta = segment.values[:, segment.column(sensor)]
    volts = c.null_volts(theta, rig.rate_hz, turning)
    # What the node holds, where the rig file does not say it.
    held = recording.metadata.get("device_null_counts", "").split(",")
    at = [a.name for a in rig.actuator].index(name)
    told = int(held[at]) if at < len(held) and held[at].strip() else 0
    old = int((own or settings).get("null", told))
    new = old + round(volts * per_unit)
    whose = "the joint stands" if len(rig.actuator) == 1 else f"the joint of {name} stands"
    said = (
        f"{whose} still at {volts:.4g} {spec.unit}; null {old} -> {new} counts\n"
        "the node holds its null itself: store it there too, or it is refused as another one's"
    )
    return c.rewritten_null(text, where, new, name if own else ""), said


def clear_fault(
    name: Annotated[str, typer.Option("--name", help="Who clears it.")],
    reason: Annotated[str, typer.Option("--reason", help="Why that is safe.")],
    rig: RigOption,
) -> None:
    """Take a latched FAULT back, after a person has looked at the rig.

    The device is opened (its output stays at zero) and must have no cause to trip any more. Who
    cleared what, and why, is in the next recording.

    Example: samii-rig clear-fault --rig my_rig.toml --name Ada --reason "hose replaced"
    """
    from samii_rig.cli.arguments import check_rig

    check_rig(rig)

    from samii_rig.devices.opening import close_device, open_device
    from samii_rig.rig.load import load_rig
    from samii_rig.safety.latch import Latch

    the_rig, _ = load_rig(rig)
    latch = Latch(the_rig.name, the_rig.device.driver)
    if latch.fault:
        # It tells the node, too, and refuses while the cause is there.
        device = open_device(the_rig, {})
        try:
            with latch.held(device):
                pass
        finally:
            close_device(device)
    cleared = latch.clear(name, reason)
    typer.echo(f"{the_rig.name}: cleared by {cleared.person}: {cleared.reason}")
    typer.echo(f"it was     {cleared.fault}")
