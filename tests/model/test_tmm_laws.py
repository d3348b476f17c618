"""Laws that hold for every kind of element: symplectic, the plain product, exact gradients."""

import numpy as np
from elements_kit import SOURCE, branch, part, rig
from hypothesis import given, settings
from hypothesis import strategies as st

from samii_rig.model import elements
from samii_rig.model.tmm import Chain
from samii_rig.rig.schema import Rig

positive = st.floats(0.1, 10.0)


@settings(max_examples=80)
@given(
    s=st.complex_numbers(min_magnitude=0.1, max_magnitude=10.0, allow_nan=False),
    a=positive,
    b=positive,
    c=positive,
    d=positive,
)
def test_every_passive_element_keeps_the_symplectic_product(
    s: complex, a: float, b: float, c: float, d: float
) -> None:
    beam = part("timoshenko_beam", EI=a, mu=b, L=1.0, GA=10 * c, J=d / 10, tau=1e-3, eta=0.01)
    passive = [
        beam,
        part("lumped_mass", m=a, I=b),
        part("torsional_spring", k=a, c=b),
        part("translational_spring", k=a, c=b),
        part("torsional_ground_spring", k=a, c=b),
        part("translational_ground_spring", k=a, c=b),
        part("gravity_stiffness", k=a),
        part("oil_column", D=a, C_h=b),
        SOURCE,
        part("hydraulic_line", source="source", D=a, L=b, A=c, rho=d, B=a, R=b),
        branch({**beam, "name": "side_beam"}),
    ]
    order = [SOURCE, passive[9], *(e for e in passive if e not in (SOURCE, passive[9]))]
    moment = {"name": "M", "kind": "moment", "after": "source", "unit": "N m"}
    for element in rig(*order, base="clamped", tip="free", sensor=[moment]).element:
        T = elements.matrix(element, np.array([s]))[0, :4, :4]
        size = np.abs(T).max() ** 2
        # A branch by the plain product loses digits near the resonance of its clamped root.
        assert np.abs(T.T @ elements.J @ T - elements.J).max() < 1e-8 * max(size, 1.0)


def everything() -> Rig:
    """One of each, with sensors that look across them."""
    beam = part(
        "timoshenko_beam", "thick", EI=2.0, mu=0.5, L=0.8, GA=60.0, J=0.01, eta=0.01, tau=1e-4
    )
    return rig(
        part("torsional_ground_spring", "foot", k=3.0, c=0.02),
        part("translational_ground_spring", "wall", k=40.0, c=0.1),
        part("beam", "slim", EI=3.0, mu=0.2, L=0.7, tau=1e-4),
        part("translational_spring", "slide", k=300.0, c=0.5),
        part("angular_velocity_source", "source", K=0.5, p=150.0, tau=2e-3),
        part(
            "hydraulic_line",
            "line",
            source="source",
            D=1e-3,
            L=2.0,
            A=1e-3,
            rho=870.0,
            B=1e6,
            R=1e4,
        ),
        part("lumped_mass", "lump", m=0.1, I=0.003),
        part("torque_source", "motor", K=0.2, p=80.0),
        beam,
        branch(
            part("torsional_spring", "side_spring", k=4.0, c=0.01),
            {**beam, "name": "side_beam"},
            part("translational_ground_spring", "side_wall", k=5.0),
            part("rigid_link", "side_link", L=0.1, r=0.05, m=0.2, I=0.001),
        ),
        part("angular_velocity_source_2", "second", K=0.3, omega=70.0, zeta=0.3),
        part("oil_column", "oil", D=0.02, C_h=1e-5),
        part("gravity_stiffness", "gravity", k=-0.5),
        part("force_source", "shaker", K=2.0),
        part("rigid_link", "end", L=0.2, r=0.1, m=0.3, I=0.004),
        base="free",
        tip="free",
        sensor=[
            {
                "name": "joint",
                "kind": "relative_angle",
                "across": ["source", "line"],
                "unit": "rad",
            },
            {
                "name": "wide",
                "kind": "relative_angle",
                "across": ["thick", "side", "second", "oil"],
                "unit": "rad",
            },
            {
                "name": "tip",
                "kind": "acceleration",
                "on": "thick",
                "position": 0.8,
                "unit": "m/s^2",
                "tilt": 1.0,
            },
            {
                "name": "mid",
                "kind": "acceleration",
                "on": "thick",
                "position": 0.3,
                "unit": "m/s^2",
            },
            {
                "name": "slim_end",
                "kind": "acceleration",
                "on": "slim",
                "position": 0.7,
                "unit": "m/s^2",
                "tilt": -1.0,
            },
            {"name": "torque", "kind": "moment", "after": "motor", "unit": "N m"},
        ],
    )


def test_a_chain_of_everything_is_the_plain_product() -> None:
    r = everything()
    chain = Chain(r)
    f = np.array([0.2, 1.0, 3.0, 8.0])
    s = 2j * np.pi * f
    z = chain.field(f)[:, 0]
    ports = {name: i for i, (name, _) in enumerate(chain.places())}
    before = 0
    for e in r.element:
        U = elements.matrix(e, s)
        if e.name == "source":
            q = Chain(r)._c.source_values[0][4:]
            from samii_rig.model.laws import line_filter

            U[:, 1, 4] *= line_filter(s, q)
        ahead = np.concatenate([z[:, before], np.ones((f.size, 1))], axis=1)
        expected = (U @ ahead[..., None])[:, :4, 0]
        before = ports[e.name]
        assert np.abs(z[:, before] - expected).max() < 1e-8 * np.abs(z[:, before]).max(), e.name


EVERYTHING = everything()
KEYS = Chain(EVERYTHING).parameters


def test_gradients_of_everything_agree_with_differences() -> None:
    """By central differences of two widths, extrapolated."""
    chain = Chain(EVERYTHING)
    f = np.array([0.3, 2.0, 11.0, 60.0])
    H, dH = chain.gradient(f)
    np.testing.assert_allclose(H, chain.response(f), rtol=1e-12)
    values = dict(zip(KEYS, chain.values(), strict=True))
    for i, key in enumerate(KEYS):
        x = values[key]
        scale = abs(x) if x else {"eta": 1e-2, "tau": 1e-4, "c": 1e-2, "R": 1.0}[key[1]]
        slopes = []
        for h in (1e-4 * scale, 2e-4 * scale):
            # A length behind a sensor at the very end, or a parameter at 0, goes up only.
            at = (0.0, h, 2 * h) if x == 0 or key[1] == "L" else (0.0, h, -h)
            y = [chain.with_values({key: x + d}).response(f) for d in at]
            if at[2] > 0:
                slopes.append((-3 * y[0] + 4 * y[1] - y[2]) / (2 * h))
            else:
                slopes.append((y[1] - y[2]) / (2 * h))
        slope = (4 * slopes[0] - slopes[1]) / 3
        size = np.abs(H) / scale
        off = np.abs(dH[..., i] - slope)
        assert (off < 2e-6 * np.maximum(np.abs(slope), size)).all(), key
