"""What tests of the gate agreement share."""

from __future__ import annotations

from samii_rig.rig.load import load_rig

SAMII = load_rig("samii")[1]


TWO = """
[[sensor]]
name = "pot_2"
kind = "relative_angle"
across = ["joint_2_source", "joint_2"]
unit = "rad"
noise_rms = 1e-4
resolution = 1e-4
low = -1.5
high = 1.5

[[agreement]]
sensor = "theta_2"
other = "pot_2"
max = 0.02
reason = "on one shaft"
"""


ONE = """
[[agreement]]
sensor = "theta_2"
other = "v_2"
over = 2.0
max = 0.03
reason = "the shipped experiments come to 0.01"
"""
