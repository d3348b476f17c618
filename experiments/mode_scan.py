"""Mode shape scan: a roving accelerometer moved along the chain, a swept sine at each place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from experiments.swept_sine import SweptSine
from samii_rig.errors import EstimateError, InputError
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Acceleration, AntiAlias, Finite, Name, NonNegative, Rig, Strict
from samii_rig.run.outcome import Outcome
from samii_rig.run.setups import Conclusion, Setup


class Place(Strict):
    """Where the roving accelerometer is put: `at` m from the upstream end of element `on`."""

    on: Name
    at: NonNegative


class Roving(Strict):
    """The roving accelerometer, as a `[[sensor]]` of a rig file describes one."""

    name: Name
    noise_rms: NonNegative = 0.0
    resolution: NonNegative = 0.0
    low: Finite
    high: Finite
    highpass_hz: NonNegative = 0.0
    antialias: AntiAlias | None = None
    calibration: str = ""

    def toml(self, place: Place) -> str:
        """The `[[sensor]]` table of a rig file with it at `place`."""
        lines = [
            "[[sensor]]",
            f'name = "{self.name}"',
            'kind = "acceleration"',
            f'on = "{place.on}"',
            f"position = {place.at!r}",
            'unit = "m/s^2"',
            f"noise_rms = {self.noise_rms!r}",
            f"resolution = {self.resolution!r}",
            f"low = {self.low!r}",
            f"high = {self.high!r}",
            f"highpass_hz = {self.highpass_hz!r}",
        ]
        if self.antialias is not None:
            a = self.antialias
            lines.append(f"antialias = {{ order = {a.order}, corner_hz = {a.corner_hz!r} }}")
        text = self.calibration.replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'calibration = "{text}"')
        return "\n".join(lines) + "\n"


class ModeScan(SweptSine):
    """A mode shape scan file: a swept sine over the modes, run once for each place.

    The roving accelerometer is no part of the rig file: each run's rig is the rig as it is,
    with this sensor at that place, and so the recording says. On a real rig a person is
    asked to move it before each run.

    reference : the fixed accelerometer to which all shapes are scaled.
    modes_hz : about where the modes lie, within 20 %.
    roving : the sensor. place : [[place]] tables, in the order of the runs.

    Yields the mode shape at every place and every fixed accelerometer over that at the
    reference, with 90 % intervals, beside the rig file's own (Fig. 8 and 9 of paper 1).
    """

    several = False
    experiment: Literal["mode_scan"]  # type: ignore[assignment]
    reference: Name
    modes_hz: Annotated[tuple[float, ...], Field(min_length=1, max_length=20)]
    roving: Roving
    place: Annotated[tuple[Place, ...], Field(min_length=1, max_length=200)]

    def setups(self, rig: Rig, rig_toml: str) -> tuple[Setup, ...]:
        """The rig with the roving accelerometer at each place."""
        where = f"experiment {self.name}"
        fixed = [s.name for s in rig.sensor if isinstance(s, Acceleration)]
        if self.reference not in fixed:
            expected = f"an accelerometer of {rig.name}: {', '.join(fixed) or 'it has none'}"
            raise InputError(where, "reference", self.reference, expected)
        low, high = sorted((self.start_hz, self.stop_hz))
        for hz in self.modes_hz:
            if not low < hz < high:
                raise InputError(where, "modes_hz", hz, f"{low:g} to {high:g} Hz, the sweep's band")
        out = []
        for i, place in enumerate(self.place):
            text = f"{rig_toml.rstrip()}\n\n{self.roving.toml(place)}"
            moved = parse(Rig, text, f"{where}, place {i + 1}")
            what = f"put {self.roving.name} on {place.on}, {place.at:g} m from its upstream end"
            out.append(Setup(moved, text, f"{i + 1:02d}", what))
        return tuple(out)

    def conclude(self, rigs: Sequence[Rig], outcomes: Sequence[Outcome], stem: Path) -> Conclusion:
        """The mode shapes as a table and a figure."""
        # They take seconds; a scan's file is looked at without them.
        from experiments.shapes import draw, scan_shapes, write_table
        from samii_rig.identify.modal import estimate_modes

        for outcome in outcomes:
            if not outcome.responses:
                raise EstimateError(f"{outcome.path.name}: {outcome.trouble}")
        # The highest level: the least noise.
        best = [max(o.responses, key=lambda r: r.level) for o in outcomes]
        modes = [estimate_modes(r, rig) for r, rig in zip(best, rigs, strict=True)]
        shapes = scan_shapes(rigs, modes, self.modes_hz, self.roving.name, self.reference)
        joints, x = [], 0.0
        for e in rigs[0].element:
            if hasattr(e, "L"):
                x += e.L.value
            elif not hasattr(e, "input"):
                joints.append((e.name, x))
        lines = []
        for m, f in enumerate(shapes.frequencies):
            low, high = f.interval()
            lines.append(f"mode {m + 1}: {f.value:.4f} Hz, 90 % from {low:.4f} to {high:.4f}")
            for p in (p for p in shapes.points if p.mode == m):
                low, high = p.value.interval()
                lines.append(
                    f"  {p.x:6.3f} m  {p.sensor} on {p.on} at {p.position:g} m: "
                    f"{p.value.value:+.4f}, 90 % from {low:+.4f} to {high:+.4f}, "
                    f"model {p.model:+.4f}"
                )
        written = (
            write_table(stem.with_name(f"{stem.name}_mode_shapes.csv"), shapes),
            draw(stem.with_name(f"{stem.name}_mode_shapes.svg"), shapes, joints),
        )
        return Conclusion(tuple(lines), written)
