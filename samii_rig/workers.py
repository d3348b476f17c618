"""Where many independent pieces of work are done: processes here, or a cluster by its address."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context, parent_process
from typing import Any

from samii_rig.errors import InputError

ANSWERS_WITHIN = "10s"  # of a scheduler
# Each process has one core; a worker of dask sets the same, so that digits are the same too.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@contextmanager
def workers(n: int | None = None, scheduler: str = "") -> Iterator[Executor]:
    """An executor: `n` processes here (None: one a core), or the cluster of a dask.distributed
    `scheduler`, such as tcp://host:8786, whose workers see the same files under the same names.

    InputError without dask, or if no scheduler answers.
    """
    if scheduler:
        with _client(scheduler) as client:
            yield client.get_executor(pure=False)
        return
    # Fresh processes: a forked one would share the threads of numerical libraries.
    with (
        _environment(ONE_THREAD),
        ProcessPoolExecutor(
            n or os.cpu_count(), get_context("spawn"), ends_with_its_parent
        ) as pool,
    ):
        yield pool


def ends_with_its_parent() -> None:
    """Have this process of `multiprocessing` end when the one that started it is gone.

    One that is killed can end nobody, and its workers would wait for work for ever.
    """
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()


def _client(scheduler: str) -> Any:
    try:
        distributed: Any = import_module("distributed")
    except ImportError as error:
        expected = "dask.distributed to be installed (pip install samii-rig[cluster])"
        raise InputError("--scheduler", "", scheduler, expected) from error
    try:
        return distributed.Client(scheduler, timeout=ANSWERS_WITHIN)
    except (OSError, ValueError) as error:
        expected = "the address of a dask scheduler that answers"
        raise InputError("--scheduler", "", scheduler, expected) from error


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    """What processes that are started meanwhile find in their environment."""
    before = {k: os.environ.get(k) for k in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for k, v in before.items():
            if v is None:
                del os.environ[k]
            else:
                os.environ[k] = v
