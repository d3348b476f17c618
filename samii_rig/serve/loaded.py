"""Where the service's processes begin: as copies of one that has loaded what they need.

To load numpy, scipy, numba and the compiled kernels takes two seconds of a processor. So one
process does it, has no threads and does nothing else; whoever works is forked from it and works at
once. It ends with the service, at the latest with the run that goes on. On macOS, whose linear
algebra does not survive a fork, each loads for itself.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib import import_module
from multiprocessing import get_context
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
    """Let a process do `begin` of that module with these arguments, and go on when we end: it has
    no parent. What is returned is who began it, and ends at once."""
    # By its name: what it loads is no burden of ours.
    starter = CONTEXT.Process(target=_begun, args=(module, arguments))
    starter.start()
    return starter


def _begun(module: str, arguments: tuple[Any, ...]) -> None:
    # Who started it is waited for when we end, and is over by then.
    if os.fork() == 0:
        import_module(module).begin(*arguments)
