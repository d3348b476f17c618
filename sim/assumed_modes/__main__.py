"""`python -m sim.assumed_modes KIND SEED --out DIR`: make one trial."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from samii_rig.errors import SamiiRigError
from samii_rig.rig.load import load_rig
from sim.assumed_modes.styles import EXCITATIONS, OPTIONS
from sim.assumed_modes.trial import KINDS, make


def main(arguments: list[str] | None = None) -> int:
    """Make the trial that the arguments name; the exit code, 0 if it was made."""
    parser = argparse.ArgumentParser(prog="sim.assumed_modes", description=__doc__)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("seed", type=int)
    parser.add_argument("--out", type=Path, required=True, help="folder of the trials")
    parser.add_argument("--rig", default="samii", help="a shipped rig or the path of a rig file")
    parser.add_argument(
        "--style",
        default="",
        help="comma-separated: "
        + ", ".join((*EXCITATIONS, *OPTIONS, "clean"))
        + "; several excitations are drawn from",
    )
    args = parser.parse_args(arguments)
    style = tuple(x for x in args.style.split(",") if x)
    try:
        print(make(args.kind, args.seed, args.out, load_rig(args.rig)[1], style))
    except SamiiRigError as error:
        print(f"sim.assumed_modes: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
