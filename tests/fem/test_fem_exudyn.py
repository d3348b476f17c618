"""SAMII in exudyn, a flexible multibody code with an absolute nodal coordinate cable.

Its slopes are gradients, its bodies move in the plane with three coordinates, its joints are its
own constraints: nothing is shared with our elements but the physics.
"""

from itertools import pairwise

import numpy as np
import pytest
from fem_kit import samii

from samii_rig.fem.model import Fem
from samii_rig.rig.schema import Beam, RigidLink, TorsionalSpring

exu = pytest.importorskip("exudyn", reason="exudyn is not installed")
item = pytest.importorskip("exudyn.itemInterface")

AXIAL = 1e9  # N, of the cable: axial modes stay far above
X, Y, SLOPE, ROTATION = 0, 1, 3, 2  # coordinates of a cable's node and of a planar body's


def exudyn_hz(elements: int) -> np.ndarray:
    """(n,) natural frequencies of SAMII with its source held, Hz."""
    mbs = exu.SystemContainer().AddSystem()
    zero = mbs.AddMarker(item.MarkerNodeCoordinate(
        nodeNumber=mbs.AddNode(item.NodePointGround()), coordinate=0))  # fmt: skip

    def coordinate(node: object, i: int) -> object:
        return mbs.AddMarker(item.MarkerNodeCoordinate(nodeNumber=node, coordinate=i))

    x, end, turn, k = 0.0, None, zero, None
    for e in samii().element:
        if isinstance(e, TorsionalSpring):
            k = e.k.value
        elif isinstance(e, Beam):
            h = e.L.value / elements
            nodes = [mbs.AddNode(item.Point2DS1(referenceCoordinates=[x + i * h, 0, 1, 0]))
                     for i in range(elements + 1)]  # fmt: skip
            for pair in pairwise(nodes):
                mbs.AddObject(item.ObjectANCFCable2D(
                    length=h, massPerLength=e.mu.value, bendingStiffness=e.EI.value,
                    axialStiffness=AXIAL, nodeNumbers=list(pair), useReducedOrderIntegration=0,
                ))  # fmt: skip
            for i in (X, Y):
                ground = [zero, coordinate(nodes[0], i)]
                mbs.AddObject(item.CoordinateConstraint(markerNumbers=ground))
            mbs.AddObject(item.CoordinateSpringDamper(
                markerNumbers=[turn, coordinate(nodes[0], SLOPE)], stiffness=k))  # fmt: skip
            x, k = x + e.L.value, None
            end = mbs.AddMarker(item.MarkerNodePosition(nodeNumber=nodes[-1]))
            turn = coordinate(nodes[-1], SLOPE)
        elif isinstance(e, RigidLink):
            node = mbs.AddNode(item.NodeRigidBody2D(referenceCoordinates=[x + e.r.value, 0, 0]))
            body = mbs.AddObject(
                item.RigidBody2D(mass=e.m.value, inertia=e.I.value, nodeNumber=node)
            )

            def place(body: object, at: float) -> object:
                where = item.MarkerBodyPosition(bodyNumber=body, localPosition=[at, 0, 0])
                return mbs.AddMarker(where)

            mbs.AddObject(item.RevoluteJoint2D(markerNumbers=[end, place(body, -e.r.value)]))
            both = [turn, coordinate(node, ROTATION)]
            mbs.AddObject(
                item.CoordinateConstraint(markerNumbers=both)
                if k is None
                else item.CoordinateSpringDamper(markerNumbers=both, stiffness=k)
            )
            end, turn = place(body, e.L.value - e.r.value), both[1]
            x, k = x + e.L.value, None
    mbs.Assemble()
    return np.sort(mbs.ComputeODE2Eigenvalues(convert2Frequencies=True)[0])


def test_the_first_four_frequencies_of_samii_are_exudyns() -> None:
    ours = Fem(samii()).modes(4).frequency_hz
    assert exudyn_hz(15)[:4] == pytest.approx(ours, rel=1e-6)  # 0.1 % is asked for
    assert exudyn_hz(60)[:4] == pytest.approx(ours, rel=1e-5)
