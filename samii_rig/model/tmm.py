"""The transfer matrix model of a rig: frequency responses, their gradients, states.

    chain = Chain(load_rig("samii")[0])
    H = chain.response(np.geomspace(0.1, 100, 1000))     # (1000, n_sensor, n_actuator)

The model is that of the two papers (see `elements` for each matrix with its equation
number), solved so that it keeps its digits at any frequency (see `sweep`).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from samii_rig.errors import InputError
from samii_rig.model import timoshenko
from samii_rig.model.allowed import Allowed
from samii_rig.model.chain import L_OF_BEAM, compile_chain
from samii_rig.model.factors import bind, characteristic, differentiate, read, read_slopes
from samii_rig.model.kernels import respond
from samii_rig.rig.schema import (
    Acceleration,
    Branch,
    Element,
    Key,
    Rig,
    Sensor,
    parameters,
)
from samii_rig.types import Complex, Float

State = Literal["w", "theta", "M", "V"]

# Values of s at once: what of the chain depends on s is then in a cache, and freshly mapped memory
# does not take as long as what is computed in it (30,000 of SAMII 17 ms, so 8).
AT_ONCE = 4096

# A jump of a state is dual to minus or plus its conjugate one: coefficients on w theta M V.
_DUAL = {
    "w": (0.0, 0.0, 0.0, 1.0),
    "theta": (0.0, 0.0, -1.0, 0.0),
    "M": (0.0, 1.0, 0.0, 0.0),
    "V": (-1.0, 0.0, 0.0, 0.0),
}


class Chain:
    """The transfer matrix model of `rig`, compiled; it never changes.

    parameters : (element, symbol) of every physical parameter, in the file's order.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._c = compile_chain(rig)
        self._changed: dict[Key, float] = {}
        self._allowed = Allowed(rig, self._c.parameters)
        self.parameters = self._c.parameters

    @property
    def rig(self) -> Rig:
        """The rig with the values in use."""
        if self._changed:
            self._rig, self._changed = _with(self._rig, self._changed), {}
        return self._rig

    @property
    def plain(self) -> Chain:
        """The chain itself, for what wraps one."""
        return self

    def values(self) -> Float:
        """(n_param,) the values of `parameters`, SI units."""
        return self._c.values.copy()

    def with_values(self, values: Mapping[Key, float]) -> Chain:
        """The same chain with other values of some `parameters`.

        Raises InputError for an unknown parameter or a value that the rig file would not allow.
        """
        new = self._c.values.copy()
        at = self._allowed.put(values, new)
        if not self._c.holds(new, at.tolist()):
            return Chain(_with(self.rig, values))
        other = Chain.__new__(Chain)
        other._rig = self._rig
        other._changed = {**self._changed, **values}
        other._c = self._c.with_values(new)
        other._allowed, other.parameters = self._allowed, self.parameters
        return other

    def response(self, frequency_hz: ArrayLike) -> Complex:
        """(n_freq, n_sensor, n_actuator) response of the continuous system, SI units.

        Actuator unit in, sensor unit out; no hold, filter or delay. Sensors and actuators
        in the rig file's order. A lag is a negative phase.

        Raises InputError for a frequency that is not above 0 Hz.
        """
        return self.evaluate(_s(frequency_hz))

    def evaluate(self, s: ArrayLike) -> Complex:
        """The same as `response` at any complex s, rad/s, shape (n,).

        At Im s < 0 it is the conjugate of its value at conj(s). At a pole it is large or
        not finite.
        """
        s, c = _vector(s), self._c
        H = np.zeros((s.size, len(self._rig.sensor), len(self._rig.actuator)), complex)
        for first in range(0, s.size, AT_ONCE):
            some = slice(first, first + AT_ONCE)
            respond.response(c.system, bind(c, s[some]), s[some], H[some])
            read(c, s[some], H[some])
        return H

    def gradient(
        self, frequency_hz: ArrayLike, wrt: Sequence[Key] | None = None
    ) -> tuple[Complex, Complex]:
        """H as `response`, and dH (n_freq, n_sensor, n_actuator, n_param) by the adjoint.

        The derivatives are by `wrt`, default all `parameters`, per SI unit of each. An
        accelerometer's position is no parameter: it keeps its distance from the upstream
        end when L changes.

        Raises InputError for a frequency that is not above 0 Hz or an unknown parameter.
        """
        return self.gradient_at(_s(frequency_hz), wrt)

    def gradient_at(
        self, s: ArrayLike, wrt: Sequence[Key] | None = None
    ) -> tuple[Complex, Complex]:
        """H (n, n_sensor, n_actuator) and dH (n, n_sensor, n_actuator, n_param) of `gradient`, at
        any complex s (n,), rad/s, as `evaluate`.

        Raises InputError for an unknown parameter or one that is asked for twice.
        """
        s, c = _vector(s), self._c
        keys = self.parameters if wrt is None else tuple(wrt)
        place = np.full(len(self.parameters) + 1, -1)
        for i, key in enumerate(keys):
            if key not in self.parameters or key in keys[:i]:
                raise InputError("gradient", "wrt", ".".join(key), "known parameters, each once")
            place[self.parameters.index(key)] = i
        sensors = self._rig.sensor
        H, dH = differentiate(c, s, place, len(keys), len(sensors), len(self._rig.actuator))
        for sensor, port, parameter in c.at_end:
            # The kernel moves this one along with the beam's end.
            if s.size and place[parameter] >= 0:
                z = self.field_at(s)[:, :, port]
                slope, bend = self._end_slopes(s, parameter, z)
                moved = (s**2)[:, None] * slope + _tilt(sensors[sensor], self._rig) * bend
                dH[:, sensor, :, place[parameter]] -= moved
        read_slopes(c, s, place, H, dH)
        return H, dH

    def _end_slopes(self, s: Complex, parameter: int, z: Complex) -> tuple[Complex, Complex]:
        """w' and theta' at the end of the beam whose L the parameter is."""
        c = self._c
        e = int(np.flatnonzero(c.slots[:, L_OF_BEAM] == parameter)[-1])
        p = c.system.pars[e].copy()
        if c.kinds[e] == "beam":
            p[timoshenko.GA] = math.inf
        return timoshenko.end_slopes(s, p, z)

    def characteristic(self, s: ArrayLike, clear: bool = False) -> tuple[Complex, Float]:
        """D(s) = mantissa * exp(log_scale), each of shape (n,); |mantissa| is 1, or 0 at a root.

        D is the determinant of the tip's two conditions on the two free states of the base,
        taken from the plain product of the matrices: its roots are the chain's poles (but
        s = 0 and s = -p of a source). It is real on the real axis and conjugate symmetric;
        analytic but for

        - a simple pole at s = -k/c of each spring with c > 0, the poles of tanh of each
          hydraulic line and those of each branch with its root clamped; `clear` multiplies
          them out (by 1 + c s/k, c s/c for k = 0, cosh, the branch's own D), and D is then
          free of them,
        - an essential singularity at s = -1/tau of each beam with tau > 0, where poles of
          the response accumulate; nothing removes it, so stay right of it,
        - a jump across the real axis if a beam has eta > 0 (a constant loss factor is not
          causal).
        """
        return characteristic(self._c, _vector(s), clear)

    def places(
        self, positions: Mapping[str, Sequence[float]] | None = None
    ) -> tuple[tuple[str, float], ...]:
        """The ports at which `field` gives states: (element, m from its upstream end).

        Port 0 is the base; then comes the end of each element, and before it, for a beam,
        the accelerometers on it and the `positions` asked for: {beam: (m, ...)}.

        Raises InputError for a position that is not on its beam.
        """
        return compile_chain(self.rig, positions).places

    def field(
        self,
        frequency_hz: ArrayLike,
        jumps: Sequence[tuple[int, State]] | None = None,
        positions: Mapping[str, Sequence[float]] | None = None,
    ) -> Complex:
        """States w, theta, M, V (m, rad, N m, N) at all `places`, (n_freq, n_jump, n_port, 4).

        jumps : None for the response to each actuator (in actuator units), else (port, state)
            each: the response to a jump of 1 (SI) of that state there. z is discontinuous at
            the jump's port; the value upstream of it is given, downstream is 1 more. This is
            the Green's function of the chain: a part left out at a port that turns the state
            i there into a jump of j, z+ = z- + e_j x (e_i^T z-), adds to every state
            field[j] x (e_i^T z-).
        positions : inner points of beams, see `places`.

        Raises InputError for a frequency that is not above 0 Hz, an unknown port or state.
        """
        return self.field_at(_s(frequency_hz), jumps, positions)

    def field_at(
        self,
        s: ArrayLike,
        jumps: Sequence[tuple[int, State]] | None = None,
        positions: Mapping[str, Sequence[float]] | None = None,
    ) -> Complex:
        """`field` at complex s (n,), rad/s: (n, n_jump, n_port, 4).

        Very near a pole it is the mode shape times 1/(s - pole).

        Raises InputError for a position that is not on its beam, an unknown port or state.
        """
        s, c = _vector(s), compile_chain(self.rig, positions)
        n_port = len(c.places)
        x, f = c.system, bind(c, s)
        if jumps is None:
            ports, duals = (
                np.ascontiguousarray(x.source[:, 0]),
                np.ascontiguousarray(x.source_c[:, :4]),
            )
        else:
            at = [(operator.index(port), state) for port, state in jumps]
            for port, state in at:
                if not 0 <= port < n_port:
                    raise InputError("field", "jumps", port, f"a port from 0 to {n_port - 1}")
                if state not in _DUAL:
                    raise InputError("field", "jumps", state, f"one of {', '.join(_DUAL)}")
            ports = np.array([port for port, _ in at], dtype=np.int64)
            duals = np.array([_DUAL[state] for _, state in at])
        out = np.zeros((s.size, ports.size, n_port, 4), complex)
        if s.size and ports.size:
            respond.fields(x, f, s, ports, duals, out)
        if jumps is not None:
            return out
        driven = np.zeros((s.size, len(self._rig.actuator), n_port, 4), complex)
        for i, actuator in enumerate(x.source[:, 1]):
            driven[:, actuator] += out[:, i] * (x.source_c[i, 4] * f.drive[i])[:, None, None]
        return driven


def _with(rig: Rig, values: Mapping[Key, float]) -> Rig:
    """The rig with other values, which have been checked."""
    elements = tuple(_element_with(element, values) for element in rig.element)
    return rig.model_copy(update={"element": elements})


def _element_with(element: Element, values: Mapping[Key, float]) -> Element:
    new: dict[str, object] = {
        symbol: parameter.model_copy(update={"value": float(values[element.name, symbol])})
        for symbol, parameter in parameters(element).items()
        if (element.name, symbol) in values
    }
    if isinstance(element, Branch):
        new["element"] = tuple(_element_with(e, values) for e in element.element)
    return element.model_copy(update=new) if new else element


def _tilt(sensor: Sensor, rig: Rig) -> float:
    return sensor.tilt * rig.tilt_gravity(sensor.on) if isinstance(sensor, Acceleration) else 0.0


def _s(frequency_hz: ArrayLike) -> Complex:
    f = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    bad = ~(np.isfinite(f) & (f > 0))
    if f.ndim != 1 or bad.any():
        shown = float(f[bad][0]) if bad.any() else f.shape
        raise InputError("frequency", "", shown, "a list of frequencies above 0 Hz")
    return _vector(2j * math.pi * f)


def _vector(s: ArrayLike) -> Complex:
    return np.atleast_1d(np.asarray(s, dtype=np.complex128))
