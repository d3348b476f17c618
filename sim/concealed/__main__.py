"""Command line of the concealed plant: `python -m sim.concealed make --help`."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from samii_rig.errors import SamiiRigError
from samii_rig.rig.load import load_rig
from sim.concealed.draw import DRAWN, Kind
from sim.concealed.runs import Design
from sim.concealed.stated import Stated
from sim.concealed.trial import make


def main(arguments: list[str] | None = None) -> int:
    """Make trials; exit code 0, or that of the mistake with one line on standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m sim.concealed",
        epilog="example: python -m sim.concealed make --seed 0 --count 28 --kind one --out trials",
    )
    usual = Design()
    commands = parser.add_subparsers(dest="command", required=True)
    maker = commands.add_parser("make", help="make trials; those that are whole are not made again")
    maker.add_argument("--seed", type=int, default=0, help="of the first trial [default: 0]")
    maker.add_argument("--count", type=int, default=1, help="consecutive seeds [default: 1]")
    what = maker.add_mutually_exclusive_group(required=True)
    what.add_argument("--kind", choices=DRAWN)
    what.add_argument(
        "--effect",
        nargs="+",
        action="append",
        default=[],
        metavar="WORD",
        help="PHYSICS SITE [SYMBOL=NUMBER ...]; several conceal them all",
    )
    maker.add_argument("--out", type=Path, required=True, help="folder of recordings and truths")
    maker.add_argument("--rig", default="samii", help="rig file or name [default: samii]")
    maker.add_argument("--noise", type=float, default=usual.noise, help="multiple of the errors")
    maker.add_argument("--burst", type=float, default=usual.burst, help="s of one swept sine")
    maker.add_argument("--bursts", type=int, help="of each level [default: 4; of two inputs 3]")
    maker.add_argument(
        "--levels",
        type=float,
        nargs="+",
        help="peaks, in the actuator's unit [default: up to a tenth of its range]",
    )
    maker.add_argument("--sensors", nargs="*", default=[], help="to record [default: all]")
    chosen = parser.parse_args(arguments)
    try:
        rig, text = load_rig(chosen.rig)
        own = Design.usual(rig)
        design = replace(
            own,
            levels=tuple(sorted(chosen.levels or own.levels)),
            bursts=chosen.bursts or own.bursts,
            burst=chosen.burst,
            noise=chosen.noise,
            sensors=tuple(chosen.sensors),
        )
        stated = tuple(Stated.of(words) for words in chosen.effect)
        kind: Kind = chosen.kind or "stated"
        for seed in range(chosen.seed, chosen.seed + chosen.count):
            begin = time.monotonic()
            folder = make(kind, seed, chosen.out, text, design, stated)
            took = time.monotonic() - begin
            print(f"{kind} {seed} {folder.name} {folder} {took:.1f} s")
    except SamiiRigError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
