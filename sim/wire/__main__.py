"""`python -m sim.wire --rig samii --link ./port`: the simulated rig behind a serial port.

The first line that it prints is JSON: the port, and the [device.settings] that belong to it.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from samii_rig.errors import InputError, SamiiRigError
from samii_rig.rig.load import load_rig
from samii_rig.run.priority import prioritised
from sim.settings import SimSettings
from sim.wire.rig import WireRig


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


def main() -> int:
    """Run until standard input ends, `quit` or Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m sim.wire", description=__doc__)
    parser.add_argument("--rig", required=True, help="a shipped rig or the path of a rig file")
    parser.add_argument("--link", type=Path, help="a symbolic link that leads to the port")
    parser.add_argument("--script", type=Path, help="faults: a line SECONDS COMMAND each")
    parser.add_argument("--seed", type=int, default=0, help="of noise and faults")
    parser.add_argument("--ideal", action="store_true", help="no noise of the sensors")
    parser.add_argument("--supply", action="store_true", help="the node switches the supply")
    chosen = parser.parse_args()
    try:
        script = read_script(chosen.script) if chosen.script else []
        settings = SimSettings(seed=chosen.seed, noise=not chosen.ideal)
        rig = WireRig(load_rig(chosen.rig)[0], settings, chosen.link, supply=chosen.supply)
    except SamiiRigError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    rig.say(rig.hello())
    try:
        # A board's clock waits for no other program.
        with prioritised():
            rig.run(script)
    except SamiiRigError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        pass
    finally:
        rig.unplug()
    return 0


if __name__ == "__main__":
    sys.exit(main())
