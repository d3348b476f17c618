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
from pydantic import ValidationError

from samii_rig.errors import InputError
from samii_rig.model import respond
from samii_rig.model.chain import compile_chain
from samii_rig.rig.schema import Element, Rig, parameters
from samii_rig.types import Complex, Float

State = Literal["w", "theta", "M", "V"]

# A jump of a state is dual to minus or plus its conjugate one: coefficients on w theta M V.
_DUAL = {
    "w": (0.0, 0.0, 0.0, 1.0),
    "theta": (0.0, 0.0, -1.0, 0.0),
    "M": (0.0, 1.0, 0.0, 0.0),
    "V": (-1.0, 0.0, 0.0, 0.0),
}


class Chain:
    """The transfer matrix model of `rig`, compiled; it never changes.

    rig : the rig with the values in use.
    parameters : (element, symbol) of every physical parameter, in the file's order.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._c = compile_chain(rig)
        self.parameters = self._c.parameters

    def values(self) -> Float:
        """(n_param,) the values of `parameters`, SI units."""
        return np.array([p.value for e in self.rig.element for p in parameters(e).values()])

    def with_values(self, values: Mapping[tuple[str, str], float]) -> Chain:
        """The same chain with other values of some `parameters`.

        Raises InputError for an unknown parameter or a value that the rig file would not allow.
        """
        for key in values:
            if key not in self.parameters:
                raise InputError("with_values", ".".join(key), values[key], "a known parameter")
        elements = tuple(_changed(element, values) for element in self.rig.element)
        return Chain(self.rig.model_copy(update={"element": elements}))

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
        H = np.zeros((s.size, len(self.rig.sensor), len(self.rig.actuator)), complex)
        if s.size:
            respond.response(c.system, s, H)
        return H

    def gradient(
        self, frequency_hz: ArrayLike, wrt: Sequence[tuple[str, str]] | None = None
    ) -> tuple[Complex, Complex]:
        """H as `response`, and dH (n_freq, n_sensor, n_actuator, n_param) by the adjoint.

        The derivatives are by `wrt`, default all `parameters`, per SI unit of each. An
        accelerometer's position is no parameter: it keeps its distance from the upstream
        end when L changes.

        Raises InputError for a frequency that is not above 0 Hz or an unknown parameter.
        """
        s, c = _s(frequency_hz), self._c
        keys = self.parameters if wrt is None else tuple(wrt)
        place = np.full(len(self.parameters) + 1, -1)
        for i, key in enumerate(keys):
            if key not in self.parameters or key in keys[:i]:
                raise InputError("gradient", "wrt", ".".join(key), "known parameters, each once")
            place[self.parameters.index(key)] = i
        H = np.zeros((s.size, len(self.rig.sensor), len(self.rig.actuator)), complex)
        dH = np.zeros((*H.shape, len(keys)), complex)
        if s.size:
            respond.gradient(c.system, s, place[c.slots], H, dH)
        for sensor, port, parameter in c.at_end:
            # The kernel moves this one along with the beam's end.
            if s.size and place[parameter] >= 0:
                theta = self.field_at(s)[:, :, port, 1]
                dH[:, sensor, :, place[parameter]] -= (s**2)[:, None] * theta
        return H, dH

    def characteristic(self, s: ArrayLike, clear: bool = False) -> tuple[Complex, Float]:
        """D(s) = mantissa * exp(log_scale), each of shape (n,); |mantissa| is 1, or 0 at a root.

        D is the determinant of the tip's two conditions on the two free states of the base,
        taken from the plain product of the matrices: its roots are the chain's poles (but
        s = 0 and s = -p of a source). It is real on the real axis and conjugate symmetric;
        analytic but for

        - a simple pole at s = -k/c of each spring with c > 0; `clear` multiplies it out
          (by 1 + c s/k), and D is then free of it,
        - an essential singularity at s = -1/tau of each beam with tau > 0, where poles of
          the response accumulate; nothing removes it, so stay right of it,
        - a jump across the real axis if a beam has eta > 0 (a constant loss factor is not
          causal).
        """
        s, c = _vector(s), self._c
        mantissa, log_scale = np.zeros(s.size, complex), np.zeros(s.size)
        if s.size:
            respond.characteristic(c.system, s, clear, mantissa, log_scale)
        return mantissa, log_scale

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
        """`field` at complex s. Very near a pole it is the mode shape times 1/(s - pole)."""
        s, c = _vector(s), compile_chain(self.rig, positions)
        n_port = len(c.places)
        if jumps is None:
            at = [(int(port), "theta") for port in c.system.source[:, 0]]
        else:
            at = [(operator.index(port), state) for port, state in jumps]
        for port, state in at:
            if not 0 <= port < n_port:
                raise InputError("field", "jumps", port, f"a port from 0 to {n_port - 1}")
            if state not in _DUAL:
                raise InputError("field", "jumps", state, f"one of {', '.join(_DUAL)}")
        out = np.zeros((s.size, len(at), n_port, 4), complex)
        if s.size and at:
            ports = np.array([port for port, _ in at], dtype=np.int64)
            respond.fields(c.system, s, ports, np.array([_DUAL[state] for _, state in at]), out)
        if jumps is not None:
            return out
        driven = np.zeros((s.size, len(self.rig.actuator), n_port, 4), complex)
        for i, (e, actuator) in enumerate(c.system.source):
            K, p = c.system.pars[e, :2]
            driven[:, actuator] += out[:, i] * (K * p / (s * (s + p)))[:, None, None]
        return driven


def _changed(element: Element, values: Mapping[tuple[str, str], float]) -> Element:
    new = {
        symbol: parameter.model_copy(update={"value": float(values[element.name, symbol])})
        for symbol, parameter in parameters(element).items()
        if (element.name, symbol) in values
    }
    if not new:
        return element
    try:
        return type(element).model_validate(element.model_copy(update=new).model_dump())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        symbol = str(first["loc"][0])
        message = first["msg"].removeprefix("Value error, ")
        value = values.get((element.name, symbol))
        raise InputError("with_values", f"{element.name}.{symbol}", value, message) from error


def _s(frequency_hz: ArrayLike) -> Complex:
    f = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    bad = ~(np.isfinite(f) & (f > 0))
    if f.ndim != 1 or bad.any():
        shown = float(f[bad][0]) if bad.any() else f.shape
        raise InputError("frequency", "", shown, "a list of frequencies above 0 Hz")
    return _vector(2j * math.pi * f)


def _vector(s: ArrayLike) -> Complex:
    return np.atleast_1d(np.asarray(s, dtype=np.complex128))
