"""How many digits the transfer matrix core keeps, against the plain product in mpmath.

The reference multiplies the papers' matrices as they stand and differentiates by central
differences, with so many digits that fifty are left: at 10 kHz the SFLR's beam alone
cancels exp(2 beta) = 1e82.
"""

import secrets
import shutil
from collections.abc import Callable
from pathlib import Path

import mpmath as mp
import numba
import numpy as np
import pytest
from elements_kit import ANGLE, SOURCE, part, rig

from samii_rig.model.kernels import lanes, waves
from samii_rig.model.tmm import Chain
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import (
    AbsoluteAngle,
    Acceleration,
    Beam,
    Element,
    LumpedMass,
    OilColumn,
    RelativeAngle,
    Rig,
    RigidLink,
    Sensor,
    TimoshenkoBeam,
    TorsionalGroundSpring,
    TorsionalSpring,
    TranslationalGroundSpring,
    TranslationalSpring,
    parameters,
)

Values = dict[tuple[str, str], mp.mpf]
DIGITS = 140
CONDITIONS = {"clamped": (0, 1), "pinned": (0, 2), "free": (2, 3)}  # zero of w theta M V


def beam(s: mp.mpc, EI: mp.mpf, mu: mp.mpf, L: mp.mpf, eta: mp.mpf, tau: mp.mpf) -> mp.matrix:
    """Paper 1, eq. (4) to (9), in the sign convention of the state vector."""
    E = EI * (1 + 1j * eta + s * tau)
    q = -mu * s**2 * L**4 / E
    b = mp.root(q, 4)
    c0, c1 = (mp.cosh(b) + mp.cos(b)) / 2, (mp.sinh(b) + mp.sin(b)) / (2 * b)
    c2, c3 = (mp.cosh(b) - mp.cos(b)) / (2 * b**2), (mp.sinh(b) - mp.sin(b)) / (2 * b**3)
    a = L**2 / E
    return mp.matrix(
        [
            [c0, L * c1, a * c2, a * L * c3, 0],
            [q * c3 / L, c0, a / L * c1, a * c2, 0],
            [q * c2 / a, L / a * q * c3, c0, L * c1, 0],
            [q * c1 / (a * L), q * c2 / a, q * c3 / L, c0, 0],
            [0, 0, 0, 0, 1],
        ]
    )


def thick(
    s: mp.mpc, EI: mp.mpf, mu: mp.mpf, L: mp.mpf, eta: mp.mpf, tau: mp.mpf, GA: mp.mpf, J: mp.mpf
) -> mp.matrix:
    """exp(A L) by its power series, 2^-k of it k times squared."""
    g = 1 + 1j * eta + s * tau
    A = mp.zeros(5)
    A[0, 1], A[0, 3], A[1, 2] = 1, -1 / (GA * g), 1 / (EI * g)
    A[2, 1], A[2, 3], A[3, 0] = J * s**2, 1, -mu * s**2
    # Scaled to like sizes before the norm of a matrix of mixed units is taken.
    D = [mp.mpf(1), 1 / L, EI / L**2, EI / L**3, mp.mpf(1)]
    A = mp.matrix(5, 5) + mp.matrix(
        [[A[i, j] * L * D[j] / D[i] for j in range(5)] for i in range(5)]
    )
    U = mp.expm(A, method="taylor")
    return mp.matrix([[U[i, j] * D[i] / D[j] for j in range(5)] for i in range(5)])


def matrix(e: Element, s: mp.mpc, v: Values) -> mp.matrix:
    def value(symbol: str) -> mp.mpf:
        return v[e.name, symbol]

    if isinstance(e, Beam):
        return beam(s, *(value(x) for x in ("EI", "mu", "L", "eta", "tau")))
    U = mp.eye(5)
    if isinstance(e, RigidLink):
        L, r, m = value("L"), value("r"), value("m")
        U[0, 1] = U[2, 3] = L
        U[2, 0], U[2, 1] = -(L - r) * m * s**2, (value("I") - (L - r) * r * m) * s**2
        U[3, 0], U[3, 1] = -m * s**2, -m * r * s**2
    elif isinstance(e, TorsionalSpring):
        U[1, 2] = 1 / (value("c") * s + value("k"))
    elif isinstance(e, TimoshenkoBeam):
        return thick(s, *(value(x) for x in ("EI", "mu", "L", "eta", "tau", "GA", "J")))
    elif isinstance(e, LumpedMass):
        U[2, 1], U[3, 0] = value("I") * s**2, -value("m") * s**2
    elif isinstance(e, TranslationalSpring):
        U[0, 3] = -1 / (value("c") * s + value("k"))
    elif isinstance(e, TranslationalGroundSpring):
        U[3, 0] = -(value("c") * s + value("k"))
    elif isinstance(e, TorsionalGroundSpring):
        U[2, 1] = value("c") * s + value("k")
    elif isinstance(e, OilColumn):
        U[1, 2] = value("C_h") / value("D") ** 2
    else:
        late = mp.exp(-s * value("tau"))
        U[1, 4] = value("K") * value("p") / (s * (s + value("p"))) * late
    return U


def values(rig: Rig) -> Values:
    return {(e.name, k): mp.mpf(p.value) for e in rig.element for k, p in parameters(e).items()}


def states(rig: Rig, f: float, v: Values) -> list[mp.matrix]:
    """w, theta, M, V and 1 at the base and after each element, for the one actuator."""
    s = 2j * mp.pi * mp.mpf(f)
    products = [mp.eye(5)]
    for e in rig.element:
        products.append(matrix(e, s, v) * products[-1])
    a, b = (i for i in range(4) if i not in CONDITIONS[rig.base])
    c, d = CONDITIONS[rig.tip]
    S = products[-1]
    det = S[c, a] * S[d, b] - S[c, b] * S[d, a]
    z0 = mp.zeros(5, 1)
    z0[4] = 1
    z0[a] = (S[c, b] * S[d, 4] - S[d, b] * S[c, 4]) / det
    z0[b] = (S[d, a] * S[c, 4] - S[c, a] * S[d, 4]) / det
    return [U * z0 for U in products]


def reference(rig: Rig, f: float, v: Values) -> list[mp.mpc]:
    """Every sensor's response to the one actuator."""
    s = 2j * mp.pi * mp.mpf(f)
    z = states(rig, f, v)
    names = [e.name for e in rig.element]
    out = []
    for sensor in rig.sensor:
        if isinstance(sensor, RelativeAngle):
            first, last = names.index(sensor.across[0]), names.index(sensor.across[-1])
            out.append(z[last + 1][1] - z[first][1])
        elif isinstance(sensor, AbsoluteAngle):
            out.append(z[names.index(sensor.after) + 1][1])
        elif isinstance(sensor, Acceleration):
            j = names.index(sensor.on)
            x = mp.mpf(sensor.position)
            if isinstance(rig.element[j], TimoshenkoBeam):
                part = {k: v[sensor.on, k] for k in ("EI", "mu", "eta", "tau", "GA", "J")}
                out.append(s**2 * (thick(s, L=x, **part) * z[j])[0])
            elif isinstance(rig.element[j], Beam) and x > 0:
                part = {k: v[sensor.on, k] for k in ("EI", "mu", "eta", "tau")}
                out.append(s**2 * (beam(s, L=x, **part) * z[j])[0])
            else:
                out.append(s**2 * (z[j][0] + x * z[j][1]))
        else:
            out.append(z[names.index(sensor.after) + 1][2])
    return out


def derivative(rig: Rig, f: float, v: Values, key: tuple[str, str]) -> list[mp.mpc]:
    h = mp.mpf(10) ** (-mp.mp.dps // 3) * (abs(v[key]) or 1)
    above, below = (
        reference(rig, f, {**v, key: v[key] + h}),
        reference(rig, f, {**v, key: v[key] - h}),
    )
    return [(x - y) / (2 * h) for x, y in zip(above, below, strict=True)]


def error(found: complex, true: mp.mpc) -> float:
    return float(abs(mp.mpmathify(complex(found)) - true) / abs(true))


def rounding(rig: Rig, f: float, sensor: Sensor, true: mp.mpc) -> float:
    """Four units in the last place of the largest angle that a relative angle adds up, over it.

    Across a source and what yields behind it that angle is what the source's jump and the
    compliance leave of each other. How the compiler joins products and sums moves its last digits.
    """
    if not isinstance(sensor, RelativeAngle):
        return 0.0
    names = [e.name for e in rig.element]
    first, last = names.index(sensor.across[0]), names.index(sensor.across[-1])
    largest = max(abs(z[1]) for z in states(rig, f, values(rig))[first : last + 2])
    return float(4 * np.finfo(float).eps * largest / abs(true))


def unlike_the_shipped_ones() -> Rig:
    """A rig with what the shipped ones lack: a loss factor, sensors on a beam, a moment, an
    angle across a beam, a pinned end."""
    rig, _ = load_rig("sflr")
    data = rig.model_dump()
    data["tip"] = "pinned"
    own = next(e for e in data["element"] if e["kind"] == "beam")
    own["eta"]["value"], own["tau"]["value"] = 0.01, 1e-4
    low = {"unit": "m/s^2", "kind": "acceleration", "on": "beam"}
    data["sensor"] = [
        *data["sensor"],
        {**low, "name": "on_beam", "position": 0.1},
        {**low, "name": "at_root", "position": 0.0},
        {**low, "name": "at_end", "position": own["L"]["value"]},
        {"name": "torque", "kind": "moment", "after": "spring", "unit": "N m"},
        {"name": "bend", "kind": "relative_angle", "across": ["clamp", "beam"], "unit": "rad"},
    ]
    return Rig.model_validate(data)


def with_other_elements() -> Rig:
    """A thick beam, joints and supports of every kind; stiff and soft beyond reason."""
    at = {"kind": "acceleration", "on": "thick", "unit": "m/s^2"}
    return rig(
        SOURCE,
        part("oil_column", "oil", D=1e-3, C_h=2e-8),
        part("torsional_ground_spring", "foot", k=30.0, c=2.0),
        part("timoshenko_beam", "thick", EI=3.0, mu=0.2, L=0.7, GA=2e3, J=1e-3, tau=2e-6, eta=0.01),
        part("translational_ground_spring", "wall", k=1e12, c=0.1),
        part("translational_spring", "slide", k=1e-3, c=1e-6),
        part("lumped_mass", "lump", m=0.1, I=0.003),
        base="clamped",
        tip="free",
        sensor=[
            {**ANGLE, "across": ["source", "oil"]},
            {**at, "name": "middle", "position": 0.3},
            {"name": "held", "kind": "absolute_angle", "after": "wall", "unit": "rad"},
            {"name": "torque", "kind": "moment", "after": "source", "unit": "N m"},
        ],
    )


RIGS: dict[str, Callable[[], Rig]] = {
    "samii": lambda: load_rig("samii")[0],
    "sflr": lambda: load_rig("sflr")[0],
    "other": unlike_the_shipped_ones,
    "elements": with_other_elements,
}


@pytest.mark.parametrize("name", RIGS)
def test_ten_digits_from_a_hundredth_of_a_hertz_to_two_kilohertz(name: str) -> None:
    rig = RIGS[name]()
    f = np.r_[np.geomspace(0.01, 2000, 24), 1.7, 7.4]
    H = Chain(rig).response(f)
    with mp.workdps(DIGITS):
        for i, x in enumerate(f):
            for j, true in enumerate(reference(rig, x, values(rig))):
                assert error(H[i, j, 0], true) < 1e-11, (x, rig.sensor[j].name)


@pytest.mark.parametrize("name", RIGS)
def test_twelve_digits_at_ten_kilohertz_where_the_plain_product_has_none(name: str) -> None:
    rig = RIGS[name]()
    H = Chain(rig).response([5000, 10000])
    with mp.workdps(DIGITS):
        for i, x in enumerate((5000, 10000)):
            for j, true in enumerate(reference(rig, x, values(rig))):
                allowed = max(1e-12, rounding(rig, x, rig.sensor[j], true))
                assert error(H[i, j, 0], true) < allowed, (x, rig.sensor[j].name)


@pytest.mark.parametrize("name", ["samii", "sflr", "other"])
def test_gradients_have_eight_digits(name: str) -> None:
    rig = RIGS[name]()
    chain = Chain(rig)
    f = np.array([0.01, 1.6, 7.4, 40.0, 2000.0])
    H, dH = chain.gradient(f)
    assert np.array_equal(H, chain.response(f))
    with mp.workdps(DIGITS):
        for i, x in enumerate(f):
            for k, key in enumerate(chain.parameters):
                for j, true in enumerate(derivative(rig, x, values(rig), key)):
                    found = dH[i, j, 0, k]
                    if abs(true) < mp.mpf(10) ** -40:
                        # What no sensor sees: the length behind the last centre of gravity,
                        # or all but the source for a perfect encoder.
                        assert found == 0, (x, key, rig.sensor[j].name)
                    else:
                        assert error(found, true) < 1e-8, (x, key, rig.sensor[j].name)


def test_the_waves_are_within_two_units_in_the_last_place() -> None:
    # Parts compile into kernels only, so a kernel of their own.
    @numba.njit
    def both(x: np.ndarray, out: np.ndarray) -> None:
        for i in range(x.size):
            out[i] = waves.decay(x[i])
            out[x.size + i] = waves.circle(x[i])

    x = np.r_[0.0, np.random.default_rng(1).uniform(0, [[1.0], [30.0], [690.0]], (3, 300)).ravel()]
    out = np.zeros(2 * x.size, complex)
    both(x, out)
    with mp.workdps(40):
        for value, e, u in zip(x, out[: x.size], out[x.size :], strict=True):
            assert error(e, mp.exp(-mp.mpf(value))) < 5e-16
            true = mp.expj(mp.mpf(value))
            assert abs(u.real - true.real) < 4e-16
            assert abs(u.imag - true.imag) < 4e-16


def test_a_kernel_is_compiled_anew_when_a_file_of_its_room_has_changed(monkeypatch):
    """And else loaded as it was compiled: the number stands for the files."""

    def make(files):
        def count(x):
            return x + 1.0 if files > 0 else x

        return count

    first, second = secrets.randbits(40) + 1, secrets.randbits(40) + 1
    for files, hits in ((first, 0), (first, 1), (second, 0), (second, 1)):
        monkeypatch.setattr(lanes, "_files", lambda files=files: files)
        compiled = lanes.kernel(make)
        assert compiled(1.0) == 2.0
        assert sum(compiled.stats.cache_hits.values()) == hits


def test_the_number_of_a_room_is_that_of_what_stands_in_it(tmp_path, monkeypatch):
    for file in Path(lanes.__file__).parent.glob("*.py"):
        shutil.copy(file, tmp_path)
    before = lanes._files()
    monkeypatch.setattr(lanes, "__file__", str(tmp_path / "lanes.py"))
    assert lanes._files() == before
    with (tmp_path / "sweep.py").open("a") as file:
        file.write("#\n")
    assert lanes._files() != before
