"""The simulated rigs on a wire as programs: options, script, a run to its end."""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Rig
from samii_rig.run.priority import PRIORITY, prioritised
from sim.settings import SimSettings
from sim.wire.rig import WireRig


def options(module: str, words: str | None, rig: str) -> ArgumentParser:
    """Those that every one has; `rig` says what its rig file is."""
    parser = ArgumentParser(prog=f"python -m {module}", description=words)
    parser.add_argument("--rig", required=True, help=rig)
    parser.add_argument("--link", type=Path, help="a symbolic link that leads to the node's port")
    parser.add_argument("--script", type=Path, help="faults: a line SECONDS COMMAND each")
    parser.add_argument("--seed", type=int, default=0, help="of noise and faults")
    parser.add_argument("--ideal", action="store_true", help="no noise of the sensors")
    return parser


def read_script(path: Path) -> list[tuple[float, str]]:
    """Lines `SECONDS COMMAND`; InputError for another."""
    script = []
    for line in path.read_text(encoding="utf-8").splitlines():
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            script.append((float(words[0]), words[1]))
        except (ValueError, IndexError) as error:
            raise InputError(str(path), "", line, "SECONDS COMMAND") from error
    return script


def run(chosen: Namespace, make: Callable[[Rig, SimSettings], WireRig]) -> int:
    """Until standard input ends, `quit` or Ctrl-C; the exit code."""
    rig = None
    try:
        script = read_script(chosen.script) if chosen.script else []
        settings = SimSettings(seed=chosen.seed, noise=not chosen.ideal)
        rig = make(load_rig(chosen.rig)[0], settings)
        rig.say(rig.hello())
        # A board's clock waits for no other program, nor for the host's.
        with prioritised() as granted:
            if granted:
                os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(PRIORITY + 1))
            rig.run(script)
    except SamiiRigError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        pass
    finally:
        if rig is not None:
            rig.close()
    return 0
