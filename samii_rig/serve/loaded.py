"""Where the service's processes begin: as copies of one that has loaded what they need.

To load numpy, scipy, numba and the compiled kernels takes two seconds of a processor. So one
process does it, has no threads and does nothing else; whoever works is forked from it and works at
once. It ends with the service, at the latest with the run that goes on. On macOS, whose linear
algebra does not survive a fork, each loads for itself.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from multiprocessing import forkserver, get_context, process
from multiprocessing.context import ForkServerContext, SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import DupFd
from typing import Any, Self

CONTEXT: ForkServerContext | SpawnContext = (
    get_context("forkserver") if sys.platform == "linux" else get_context("spawn")
)
if sys.platform == "linux":
    CONTEXT.set_forkserver_preload(["samii_rig.serve.preload"])


class Descriptor:
    """An open file's number, which a process that is started with it has too, as one of its own."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[Callable[[Any], Self], tuple[Any]]:
        return self._taken, (DupFd(self.number),)

    @classmethod
    def _taken(cls, theirs: Any) -> Self:
        return cls(theirs.detach())


def independent(module: str, *arguments: Any) -> BaseProcess:
    """A process that goes on when we end: it does `begin` of that module with these arguments."""
    # By its name: what it loads is no burden of ours.
    child = CONTEXT.Process(target=_begun, args=(module, arguments))
    child.start()
    # At our end multiprocessing would wait for it.
    vars(process)["_children"].discard(child)
    return child


def _begun(module: str, arguments: tuple[Any, ...]) -> None:
    import_module(module).begin(*arguments)


def end() -> None:
    """End the one that has loaded it all, and may still do so: nobody would end before it has.

    What was forked from it goes on.
    """
    pid = vars(getattr(forkserver, "_forkserver")).get("_forkserver_pid")  # noqa: B009
    if pid:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
