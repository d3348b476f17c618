"""Names of the columns that a device has beside those of the rig file."""

from __future__ import annotations

from samii_rig.rig.schema import Rig


def reference_names(rig: Rig, actuator: str) -> tuple[str, str]:
    """Columns of u and theta_ref of one actuator: these names where it is the rig's only one,
    else with its own name behind them, `u_v_2` and `theta_ref_v_2`."""
    if len(rig.actuator) == 1:
        return "u", "theta_ref"
    return f"u_{actuator}", f"theta_ref_{actuator}"
