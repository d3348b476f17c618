"""The data that flows through the system, and nothing else: pictures of it and other libraries'
forms are made elsewhere, and imported when they are asked for.

Axes are named here once and never change order. Values are in SI units unless the
channel's `unit` says otherwise (an actuator's input may be counts).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntFlag
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from samii_rig.display import FORMS, card

if TYPE_CHECKING:
    import control
    import xarray
    from plotly.graph_objects import Figure

    from samii_rig.rig.schema import Rig

Float = NDArray[np.float64]
Complex = NDArray[np.complex128]
Int = NDArray[np.int64]
Flags = NDArray[np.uint8]

Role = Literal["reference", "command", "sensor", "monitor"]


class Quality(IntFlag):
    """What is known to be wrong with one value of one channel."""

    GOOD = 0
    MISSING = 1  # never arrived; the value is NaN
    CLIPPED = 2  # at the end of the converter's range
    STALE = 4  # repeated by the device because nothing newer was there
    LIMITED = 8  # the device's own limit or deadman changed the output


OUTSIDE = 0.01  # of a converter's range, by which a value lies beyond it


@dataclass(frozen=True, slots=True)
class Channel:
    """One column of a recording.

    role: `reference` was chosen by us and is known exactly (the excitation u),
    `command` went out to the actuator (v), `sensor` was measured, `monitor` says how the rig
    is (a supply pressure) and no response is estimated from it.
    low, high: ends of the converter's range in `unit`.
    resolution: one step of the converter in `unit`; 0 when unknown.
    """

    name: str
    unit: str
    role: Role = "sensor"
    low: float = -np.inf
    high: float = np.inf
    resolution: float = 0.0
    description: str = ""

    def beyond(self, x: Float) -> float:
        """The value of x (n,) farthest outside the converter's range, by more than a hundredth of
        it; 0 if there is none. No converter reads that: it has another unit, or is another's."""
        far = np.maximum(self.low - x, x - self.high)
        span = self.high - self.low
        if not np.isfinite(span) or not np.nanmax(far, initial=0.0) > OUTSIDE * span:
            return 0.0
        return float(x[int(np.nanargmax(far))])


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Consecutive samples as they came from a device.

    time : (n,) int64, ns on the device's clock, the instant of sampling.
    sequence : (n,) int64, counts every sample the device took; a jump is a loss.
    values : (n, n_channels) float64 in each channel's unit; NaN where missing.
    quality : (n, n_channels) uint8 of `Quality`.
    """

    channels: tuple[Channel, ...]
    time: Int
    sequence: Int
    values: Float
    quality: Flags

    def __len__(self) -> int:
        return int(self.time.shape[0])


Kind = Literal["burst", "periodic", "single", "transient"]
"""What a segment promises: a `burst` starts and ends at rest; a `periodic` one is a whole number
of periods of a periodic reference; a `single` one promises neither; a `transient` (a step) is for
looking at in time, and no frequency response is estimated from it."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A part of a recording in which one thing was done: one sweep at one amplitude.

    start, stop : sequence numbers, half open; lead-in and ring-down are inside.
    level : peak amplitude of the reference in `unit`; levels are never pooled silently.
    repeat : 0, 1, ...; segments of equal `kind` and `level` with the same reference.
    excited : commands that were driven, of a rig with several; the others rested. Empty where
        there is but one.
    """

    name: str
    kind: Kind
    start: int
    stop: int
    level: float
    unit: str
    repeat: int = 0
    excited: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class StopRecord:
    """How a run ended. `reason` is one line for the person."""

    status: Literal["completed", "stopped", "tripped", "failed", "unknown"]
    reason: str
    late_ticks: int = 0
    missing_samples: int = 0


@dataclass(frozen=True, slots=True)
class Finding:
    """Something noticed in the data that is not physics, in plain words.

    kind : one of gap, clipping, range, resolution, stuck, repeat, leakage, timing, clock, offset,
        saturation, closed_loop, distortion, dof.
    severity : `note` informs, `warning` weakens the result, `error` made us exclude or refuse.
    """

    kind: str
    severity: Literal["note", "warning", "error"]
    message: str
    channel: str = ""
    segment: str = ""


@dataclass(frozen=True, slots=True)
class Recording:
    """A run, whole: every sample and all that is needed to repeat it.

    time, sequence : (n,) int64; values : (n, n_channels); quality : (n, n_channels).
    rig_toml, experiment_toml : the files as they were, "" when there was none.
    metadata : seed, versions, operator, start time, device, import map, source hashes...
    source : where it was read from, for messages.
    clock_offset : ns by which the wall clock was ahead of the device's; 0 where nobody knows.
    """

    channels: tuple[Channel, ...]
    rate_hz: float
    time: Int
    sequence: Int
    values: Float
    quality: Flags
    segments: tuple[Segment, ...] = ()
    rig_toml: str = ""
    experiment_toml: str = ""
    metadata: dict[str, str] = field(default_factory=dict)
    stop: StopRecord = StopRecord("unknown", "the recording holds no stop record")
    source: str = ""
    clock_offset: int = 0

    def __len__(self) -> int:
        return int(self.time.shape[0])

    @property
    def wall_time(self) -> Int:
        """(n,) ns since 1970 in UTC: what the recording's messages are stamped with."""
        return self.time + self.clock_offset

    def column(self, name: str) -> int:
        """Index of the channel called `name`; KeyError if there is none."""
        for i, channel in enumerate(self.channels):
            if channel.name == name:
                return i
        raise KeyError(name)

    def values_of(self, name: str) -> Float:
        """(n,) values of one channel, not copied; KeyError if there is none."""
        return self.values[:, self.column(name)]

    def largest(self, name: str) -> float:
        """Largest absolute value of a channel, in its unit; 0 where no sample has one."""
        return float(np.nanmax(np.abs(self.values_of(name)), initial=0.0))

    def columns(self, names: Sequence[str]) -> Float:
        """(n, len(names)) values of some channels; those that stand beside each other in this
        order are not copied. KeyError if there is none of a name."""
        at = [self.column(n) for n in names]
        beside = bool(at) and at == list(range(at[0], at[0] + len(at)))
        # Of an hour a copy is as large as the recording itself.
        return self.values[:, at[0] : at[0] + len(at)] if beside else self.values[:, at]

    def names(self, role: Role) -> tuple[str, ...]:
        """Names of all channels with this role, in column order."""
        return tuple(c.name for c in self.channels if c.role == role)

    def place(self, segment: Segment) -> str:
        """Where a segment is, for messages: the source, if there is one, and its name."""
        return f"{self.source}, {segment.name}" if self.source else segment.name

    def cut(self, segment: Segment) -> Recording:
        """The samples of one segment as a recording of its own."""
        a, b = np.searchsorted(self.sequence, [segment.start, segment.stop])
        return replace(
            self,
            time=self.time[a:b],
            sequence=self.sequence[a:b],
            values=self.values[a:b],
            quality=self.quality[a:b],
            segments=(segment,),
        )

    def to_numpy(self) -> dict[str, NDArray[Any]]:
        """(n,) arrays by name: `time_s` from the first sample on, `sequence`, every channel."""
        made: dict[str, NDArray[Any]] = FORMS["columns"](self)
        return made

    def to_xarray(self) -> xarray.Dataset:
        """A variable a channel over `time`, with units (`record.convert.samples`)."""
        made: xarray.Dataset = FORMS["samples"](self)
        return made

    def plot(self) -> Figure:
        """Every channel over time; one segment at a time, chosen above."""
        made: Figure = FORMS["series"](self)
        return made

    def _repr_html_(self) -> str:
        missing = np.sum((self.quality & Quality.MISSING) != 0, axis=0)
        rows = []
        for i, c in enumerate(self.channels):
            good = self.values[np.isfinite(self.values[:, i]), i]
            ends = (f"{good.min():.4g}", f"{good.max():.4g}") if good.size else ("", "")
            rows.append((c.name, c.unit, c.role, *ends, int(missing[i]) or ""))
        levels = Counter(f"{s.kind} at {s.level:g} {s.unit}" for s in self.segments)
        facts = {
            "samples": f"{len(self):,} at {self.rate_hz:g} Hz, {len(self) / self.rate_hz:.4g} s",
            "segments": ", ".join(f"{n} x {what}" for what, n in levels.items()),
            "ended": f"{self.stop.status}: {self.stop.reason}",
            "from": self.source,
        }
        head = ("channel", "unit", "role", "smallest", "largest", "missing")
        return card("Recording", facts, head, rows)


@dataclass(frozen=True, slots=True)
class FrequencyResponse:
    """A frequency response with what is known of its error.

    frequency : (n_freq,) Hz, increasing.
    H : (n_freq, n_out, n_in) complex, output unit per input unit.
    covariance : (n_freq, p, p) complex, p = n_out * n_in: E[dH dH^H] of the circular
        complex error dH = H.reshape(n_freq, p) - truth; the real and the imaginary part
        of one entry have variance C/2 each.
    dof : (n_freq,) complex degrees of freedom nu of `covariance` (complex Wishart): with
        p entries, dH^H C^-1 dH is distributed as nu p/(nu-p+1) F(2p, 2(nu-p+1)). With several
        inputs nu counts all columns of H together; one entry alone has `entry_dof`.
    coherence : (n_freq, n_out) multiple coherence: with one input the ordinary one.
    level : amplitude of the reference in `level_unit`; NaN when mixed.
    input_rms : (n_freq, n_in) rms of the input at each line, in the input's unit,
        NaN when unknown: what a describing function is read against.
    even, odd : (n_freq, n_out) relative distortion levels, or None where the excitation
        does not show them.
    noise, distortion : (n_freq, n_out) rms of the noise of one repeat, and of what is not linear
        in one realisation, relative to the output at the line; None where they are not separated.
    followers, follow : commands that nothing drove and their loops moved, and (n_freq,
        n_followers, n_in) how far, per unit of each input; None without any. H is that with
        these loops closed (`samii_rig.signal.several.undriven`).
    method, why : which estimator, and why it was chosen, in plain words.
    sources : names or hashes of the recordings it came from.
    """

    frequency: Float
    H: Complex
    covariance: Complex
    dof: Float
    coherence: Float
    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    level: float
    level_unit: str
    input_rms: Float
    rate_hz: float
    n_averages: int
    method: str
    why: str
    even: Float | None = None
    odd: Float | None = None
    noise: Float | None = None
    distortion: Float | None = None
    findings: tuple[Finding, ...] = ()
    sources: tuple[str, ...] = ()
    followers: tuple[Channel, ...] = ()
    follow: Complex | None = None

    @property
    def estimator(self) -> str:
        """The first word of `method`: `burst`, `settled`, `periodic`, `stepped`, `local`, ..."""
        return self.method.split()[0]

    @property
    def entry_dof(self) -> Float:
        """(n_freq,) degrees of freedom of the variance of one entry: each input's column has its
        own part of `dof`."""
        return self.dof / len(self.inputs)

    def variance(self) -> Float:
        """(n_freq, n_out, n_in) E|dH|^2, the diagonal of `covariance`."""
        return np.diagonal(self.covariance, axis1=1, axis2=2).real.reshape(self.H.shape)

    def to_numpy(self) -> dict[str, NDArray[Any]]:
        """All of it, words too, as arrays by name: those of the file that `.npz` exports."""
        made: dict[str, NDArray[Any]] = FORMS["arrays"](self)
        return made

    def to_xarray(self) -> xarray.Dataset:
        """H, its deviation and covariance by names of channels (`record.convert.lines`)."""
        made: xarray.Dataset = FORMS["lines"](self)
        return made

    def to_control(self) -> control.FrequencyResponseData:
        """H as python-control's FRD: outputs and inputs by name, rad/s."""
        made: control.FrequencyResponseData = FORMS["frd"](self)
        return made

    def plot(self, output: str = "", input: str = "", rig: Rig | None = None) -> Figure:
        """Bode diagram of one entry with its 90 % bands, and the model of `rig` over it.

        output, input : names of channels; by default the first.
        """
        made: Figure = FORMS["bode"]([self], output, input, rig)
        return made

    def _repr_html_(self) -> str:
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.sqrt(self.variance()) / np.abs(self.H)
        f = self.frequency
        rows = [
            (
                f"{y.name}/{u.name}",
                f"({y.unit})/({u.unit})",
                f"{100 * np.nanmedian(relative[:, i, j]):.2g} %",
                f"{np.nanmedian(self.coherence[:, i]):.4f}",
            )
            for i, y in enumerate(self.outputs)
            for j, u in enumerate(self.inputs)
        ]
        facts = {
            "lines": f"{len(f)}, {f[0]:.4g} to {f[-1]:.4g} Hz",
            "level": f"{self.level:g} {self.level_unit}",
            "method": f"{self.method}, {self.n_averages} averages. {self.why}",
            "noticed": "; ".join(x.message for x in self.findings if x.severity != "note"),
        }
        head = ("entry", "unit", "standard deviation (median)", "coherence (median)")
        return card("Frequency response", facts, head, rows)
