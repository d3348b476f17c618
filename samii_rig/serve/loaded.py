"""Where the service's processes begin: as copies of one that has loaded what they need.

To load numpy, scipy, numba and the compiled kernels takes a process two seconds of a processor. So
one process does it, has no threads and does nothing else; whoever works is forked from it and works
at once. It ends with the service. On macOS, whose linear algebra does not survive a fork, each loads
for itself.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from multiprocessing import forkserver, get_context

CONTEXT = get_context("forkserver" if sys.platform == "linux" else "spawn")
if sys.platform == "linux":
    CONTEXT.set_forkserver_preload(["samii_rig.serve.preload"])


def end() -> None:
    """End the one that has loaded it all, and may still do so: nobody would end before it has.

    What was forked from it goes on.
    """
    pid = vars(getattr(forkserver, "_forkserver")).get("_forkserver_pid")  # noqa: B009
    if pid:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
