"""The serial I/O node: a microcontroller that closes the loop; see docs/reference/serial-node.md.

The C files beside this are the portable part of its firmware; a board needs `node.h`.
"""

from drivers.serial_node.rig import open_rig
from drivers.serial_node.settings import read_settings as check_rig

__all__ = ["check_rig", "open_rig"]
