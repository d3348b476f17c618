"""`python -m sim.wire --rig samii --link ./port`: the simulated rig behind a serial port.

The first line that it prints is JSON: the port, and the [device.settings] that belong to it.
"""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

from samii_rig.rig.schema import Rig
from sim.settings import SimSettings
from sim.wire.emulator import other_cores
from sim.wire.program import options, run
from sim.wire.rig import WireRig


def main() -> int:
    """Run until standard input ends, `quit` or Ctrl-C."""
    parser = options("sim.wire", __doc__, "a shipped rig or the path of a rig file")
    parser.add_argument("--supply", action="store_true", help="the node switches the supply")
    said = "the node is this firmware, run by QEMU (make board=qemu in drivers/serial_node/board)"
    parser.add_argument("--image", type=Path, help=said)
    chosen = parser.parse_args()

    beside = contextlib.ExitStack()

    def make(rig: Rig, settings: SimSettings) -> WireRig:
        made = WireRig(rig, settings, chosen.link, supply=chosen.supply, image=chosen.image)
        if chosen.image:
            beside.enter_context(other_cores())
        return made

    with beside:
        return run(chosen, make)


if __name__ == "__main__":
    sys.exit(main())
