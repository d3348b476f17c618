"""What data a diagnosis needs, and what each part of the method buys.

    samii-rig prove --keep --nothing 60 --one 60 --force 40 --two 0 --outside 0 --joints 0 \\
        --varying 0 --out kept
    python benchmarks/data_needed.py kept

makes kept/evidence/data-needed.md and its picture in kept/images. The trials that conceal nothing,
or one effect of 10 to 100 sigma, are diagnosed with less: more noise, fewer sensors, levels and
repeats, a shorter part of each record; and with one part of the method taken out. Each row has the
trials in which there is something to leave out, and stands beside the whole data of the very same
trials. Answers are kept in kept/needed and not made again: with --minutes it stops there, and the
page is of the trials that have all answers. Several campaigns may be given: the page is put in the
first, or in the folder that --docs names.
OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from samii_rig.diagnose.batch import How, responses_by_pose
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.diagnose.posed import in_poses
from samii_rig.errors import SamiiRigError
from samii_rig.likelihood.noise import Disturbances
from samii_rig.plain import plain
from samii_rig.prove.outcomes import truth_of
from samii_rig.prove.score import Score, confidently_wrong, detected, frequency
from samii_rig.prove.trial import REFUSED, Answer, Trial
from samii_rig.record.export import replacing
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import parameters
from samii_rig.signal.columns import centring_of, is_open
from samii_rig.types import Complex, Float, Recording, Segment

# Sigma that a refit leaves in the whole data: from the first on an effect should be found, beyond
# the second it is with a tenth of the data.
FROM, TO = 10.0, 100.0
SECONDS = 20.0  # of the diagnosis in its campaign: of longer ones there would be few trials
NULLS = 4  # every so manieth trial conceals nothing
PAGE, PICTURE = Path("evidence/data-needed.md"), Path("images/data-needed.png")
WIDE, HIGH, DPI = 11.0, 6.0, 110  # inches of the picture, and dots per inch

Recordings = Sequence[Recording]
Less = Callable[[Recordings, Rig], list[Recording] | None]
"""The recordings with less in them; None where there is nothing to leave out."""


def in_loop(rig: Rig) -> set[str]:
    """The sensors that a loop is closed about."""
    centrings = (rig.centring_of(a.name) for a in rig.actuator)
    return {c.sensor for c in (*centrings, *rig.feedback) if c is not None}


def noisier(factor: float) -> Less:
    """White noise, so that each sensor's own is `factor` times as large as the rig file says.

    The command has what the centring makes of it, so that its law holds: the input r = v + kp theta
    stays, and what the rig would have answered to it (kp K is some 2 rad/s) is left out. Not of
    rigs with a filter in a loop.
    """

    def change(runs: Recordings, rig: Rig) -> list[Recording] | None:
        if rig.feedback:
            return None
        rng = np.random.default_rng(7)
        return [_noisier(run, rig, factor, rng) for run in runs]

    return change


def _noisier(run: Recording, rig: Rig, factor: float, rng: np.random.Generator) -> Recording:
    values = run.values.copy()
    loop = centring_of(run)
    for s in rig.sensor:
        if s.name not in run.names("sensor"):
            continue
        rms = np.sqrt((factor**2 - 1) * (s.noise_rms**2 + s.resolution**2 / 12))
        added = rms * rng.normal(size=len(values))
        values[:, run.column(s.name)] += added
        if loop is not None and loop[0] == s.name:
            (command,) = run.names("command")
            if not is_open(run, command, *loop):
                values[:, run.column(command)] -= loop[1] * added
    return replace(run, values=values)


def fewer(part: float) -> Less:
    """The first part of the sensors, at least one, and those that a loop needs."""

    def change(runs: Recordings, rig: Rig) -> list[Recording] | None:
        names = runs[0].names("sensor")
        loop = in_loop(rig)
        ordered = sorted(names, key=lambda n: n not in loop)
        kept = set(ordered[: max(round(part * len(names)), len(loop), 1)])
        if len(kept) == len(names) or any(set(run.names("sensor")) != set(names) for run in runs):
            return None
        out = []
        for run in runs:
            at = [i for i, c in enumerate(run.channels) if c.role != "sensor" or c.name in kept]
            channels = tuple(run.channels[i] for i in at)
            values, quality = run.values[:, at], run.quality[:, at]
            out.append(replace(run, channels=channels, values=values, quality=quality))
        return out

    return change


def highest_level(runs: Recordings, _: Rig) -> list[Recording] | None:
    """The segments of the highest level."""
    top = max(s.level for run in runs for s in run.segments)
    return _segments(runs, lambda s: s.level == top)


def first_repeats(runs: Recordings, _: Rig) -> list[Recording] | None:
    """The first repeat of each."""
    seen: set[tuple[object, ...]] = set()

    def is_first(s: Segment) -> bool:
        key = (s.name.rsplit("_", 1)[0], s.kind, s.level, s.excited)
        known = key in seen
        seen.add(key)
        return s.repeat == 0 and not known

    return _segments(runs, is_first)


def _segments(runs: Recordings, keep: Callable[[Segment], bool]) -> list[Recording] | None:
    """Of each recording the segments that are kept, of which it has some; None where that is all or
    nothing."""
    kept = [replace(run, segments=tuple(s for s in run.segments if keep(s))) for run in runs]
    count = sum(len(run.segments) for run in kept)
    if count in (0, sum(len(run.segments) for run in runs)):
        return None
    return [run for run in kept if run.segments]


def shorter(part: float) -> Less:
    """The first part of each segment, which ends there while the rig still moves."""

    def change(runs: Recordings, _: Rig) -> list[Recording] | None:
        if all(s.kind == "transient" for run in runs for s in run.segments):
            return None
        out = []
        for run in runs:
            end = int(run.sequence[-1]) + 1
            own = tuple(
                replace(
                    s,
                    kind="transient" if s.kind == "transient" else "single",
                    stop=s.start + round(part * (min(s.stop, end) - s.start)),
                )
                for s in run.segments
            )
            out.append(replace(run, segments=own))
        return out

    return change


def same(runs: Recordings, _: Rig) -> list[Recording]:
    """As they are."""
    return list(runs)


def several_levels(runs: Recordings, rig: Rig) -> list[Recording] | None:
    """As they are, where there are several levels."""
    return list(runs) if highest_level(runs, rig) else None


def certain(rig: Rig) -> Rig:
    """The rig without tolerances: nothing is refitted."""
    elements = tuple(
        e.model_copy(
            update={s: p.model_copy(update={"tolerance": 0.0}) for s, p in parameters(e).items()}
        )
        for e in rig.element
    )
    return rig.model_copy(update={"element": elements})


def _alone(whole: Whole, fitted: Fitted) -> Disturbances:
    """Noise of the sensors alone, nothing that comes through the rig."""
    every, q = _DISTURBED(whole, fitted), whole.sensor.size

    def at(f: Float) -> Complex:
        return np.asarray(every(f)[:, :, :q])

    return at


_DISTURBED = Whole.disturbed


@contextmanager
def _replaced(of: type, **names: Any) -> Iterator[None]:
    """Methods of a class replaced for a while."""
    with patch.multiple(of, **names):
        yield


@dataclass(frozen=True, slots=True)
class Case:
    """less : what is done to the recordings. held : to the rig file. without : what is taken out of
    the method. whole : whether records count by their samples."""

    curve: str
    at: str
    less: Less = same
    held: Callable[[Rig], Rig] = field(default=lambda rig: rig)
    without: Callable[[], AbstractContextManager[object]] = nullcontext
    whole: bool = True

    @property
    def key(self) -> str:
        """A file's name."""
        return f"{self.curve} {self.at}".strip().replace(" ", "_").replace("/", "_of_")

    def answer(self, runs: Recordings, rig: Rig) -> dict[str, object]:
        """What a diagnosis says, or {"nothing": ...} where there is nothing to leave out."""
        own = self.less(runs, rig)
        if own is None:
            return {"nothing": "to leave out"}

        try:
            with self.without():
                each = responses_by_pose(own, rig, How())
                if not self.whole:
                    each = [replace(one, runs=()) for one in each]
                said: dict[str, object] = plain(in_poses(each, self.held(rig)).plain())
        except SamiiRigError as error:
            return {"refused": str(error)}
        return said


ALL = Case("everything", "")
CURVES = ("noise", "sensors", "levels", "length", "repeats")
OUT = "without"
CASES = (
    ALL,
    Case("noise", "x 3", noisier(3.0)),
    Case("noise", "x 10", noisier(10.0)),
    Case("sensors", "half", fewer(0.5)),
    Case("sensors", "one", fewer(0.0)),
    Case("levels", "highest", highest_level),
    Case("length", "1/2", shorter(0.5)),
    Case("length", "1/4", shorter(0.25)),
    Case("repeats", "one", first_repeats),
    Case(OUT, "the transient", whole=False),
    Case(OUT, "the discrepancy",
         without=lambda: _replaced(RecordSearch, overdispersion_of=lambda _self, _fitted: 1.0)),
    Case(OUT, "the nominal refit", held=certain),
    Case(OUT, "the levels", several_levels,
         without=lambda: _replaced(Whole, by_level=lambda self: self)),
    Case(OUT, "the noise model", without=lambda: _replaced(Whole, disturbed=_alone)),
)  # fmt: skip
SAID = {
    "noise": "sensors' noise, of the rig file's",
    "sensors": "sensors",
    "levels": "levels",
    "length": "part of each record",
    "repeats": "repeats",
}


def kept_at(folder: Path, case: Case) -> Path:
    """The file of an answer."""
    return folder.parents[1] / "needed" / case.key / f"{folder.name}.json"


def answered(folder: Path, until: float) -> bool:
    """Diagnose one trial in the cases that have no answer yet, each kept as soon as it is there;
    whether all have one."""
    left = [case for case in CASES if not kept_at(folder, case).exists()]
    if not left:
        return True
    runs = [read_recording(log) for log in sorted(folder.glob("*.mcap"))]
    rig = parse(Rig, next(r.rig_toml for r in runs if r.rig_toml), str(folder))
    for case in left:
        if time.monotonic() > until:
            return False
        said = {**case.answer(runs, rig), "commit": commit()}
        kept = kept_at(folder, case)
        kept.parent.mkdir(parents=True, exist_ok=True)
        with replacing(kept) as part:
            part.write_text(json.dumps(said), encoding="utf-8")
    return True


REFUSAL = {"verdict": REFUSED, "causes": [], "sites": [], "fit": {}}


def trial_of(folder: Path, case: Case) -> Trial | None:
    """The trial with its answer; None where there was nothing to leave out."""
    said = json.loads(kept_at(folder, case).read_text("utf-8"))
    if "nothing" in said:
        return None
    if "refused" in said:
        print(f"{folder.name} {case.key}: {said['refused']}", file=sys.stderr, flush=True)
        said = REFUSAL
    return Trial(truth_of(folder.parents[1], folder.name), Answer.of(said))


@dataclass(frozen=True, slots=True)
class Told:
    """What came of some trials: of those that conceal nothing and of those that do. refused : how
    many of both."""

    refused: int
    alarms: Score
    place: Score
    name: Score
    wrong: Score

    @classmethod
    def of(cls, trials: Sequence[Trial]) -> Told:
        """Of the trials of one case."""
        nothing = [t for t in trials if t.truth.kind == "nothing"]
        some = [t for t in trials if t.truth.kind != "nothing"]
        return cls(
            sum(t.answer.verdict == REFUSED for t in trials),
            frequency("", [detected(t) for t in nothing]),
            frequency("", [t.place_right for t in some]),
            frequency("", [t.right for t in some]),
            frequency("", [confidently_wrong(t) for t in trials]),
        )


@dataclass(frozen=True, slots=True)
class Row:
    """A case beside the whole data of the same trials. hidden, nothing : trials that conceal an
    effect, and nothing. sigma : of what is told, of that in the whole data, the median of the
    effects named right in both."""

    case: Case
    hidden: int
    nothing: int
    whole: Told
    less: Told
    sigma: float

    @classmethod
    def of(cls, case: Case, folders: Sequence[Path]) -> Row | None:
        """Over all trials in which there is something to leave out; None where there is none."""
        each = ((trial_of(f, ALL), trial_of(f, case)) for f in folders)
        both = [(a, b) for a, b in each if a is not None and b is not None]
        hidden = sum(a.truth.kind != "nothing" for a, _ in both)
        if not hidden:
            return None
        kept = [
            b.answer.sigma / a.answer.sigma
            for a, b in both
            if a.truth.kind != "nothing" and a.right and b.right and a.answer.sigma > 0
        ]
        sigma = statistics.median(kept) if kept else float("nan")
        whole, less = (Told.of(some) for some in zip(*both, strict=True))
        return cls(case, hidden, len(both) - hidden, whole, less, sigma)

    def line(self) -> str:
        """Of the page's table."""

        def cell(a: Score, b: Score) -> str:
            return f"{a.value:.0%} to {b.value:.0%}" if b.n else ""

        told = ((getattr(self.whole, k), getattr(self.less, k)) for k in ("place", "name", "wrong"))
        alarms = cell(self.whole.alarms, self.less.alarms)
        cells = [*(cell(*pair) for pair in told), alarms, str(self.less.refused or "")]
        what = f"{self.case.curve} {self.case.at}".strip()
        kept = f"{self.sigma:.2f}" if self.sigma == self.sigma else ""
        return f"| {what} | {self.hidden} + {self.nothing} | {' | '.join(cells)} | {kept} |"


@cache
def commit() -> str:
    """Of this code."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    return subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()


def page(rows: Sequence[Row], whole: Sequence[Path], nothing: int) -> str:
    """The tables, with how they were made. whole : folders of all trials, of which so many conceal
    nothing."""
    hidden = len(whole) - nothing
    kept = (kept_at(f, case).read_text("utf-8") for f in whole for case in CASES)
    commits = sorted({json.loads(text)["commit"] for text in kept})
    return "\n".join(
        [
            "# What data a diagnosis needs\n",
            "Made by `python benchmarks/data_needed.py`, with the code of commit",
            f"{' and '.join(commits)}, of {hidden} trials",
            f"of many rigs and styles, that conceal one effect of {FROM:g} to",
            f"{TO:g} sigma, and {nothing} that conceal nothing. Each row leaves one thing out.",
            "It has the trials in which there is something to leave out, and tells what came of",
            "them with everything and without it. Trials whose diagnosis took more than",
            f"{SECONDS:g} s are not among them. With {hidden} trials a share is known to some",
            f"{_width(hidden):.0%} either way; as a row has the same trials twice, a change of",
            "half that counts.\n",
            f"![Effects told right, by what the recordings have](../{PICTURE})\n",
            "| left out | trials with an effect + with none | place right | name right | "
            "confidently wrong | missing where nothing is | refused | sigma told, of that with "
            "everything |",
            "|---|---|---|---|---|---|---|---|",
            *(r.line() for r in rows),
            "",
            "- `noise`: white noise is added to each sensor, and to the command what the loop",
            "  makes of it.",
            "- `sensors`: the first half in the rig file's order, and the first; those of loops",
            "  stay.",
            "- `levels`, `repeats`: the highest level alone, and the first repeat of each.",
            "- `length`: each record ends there, while the rig moves; a sweep loses what is above.",
            "- Without the transient: responses line by line, estimated before any model is known.",
            "- Without the discrepancy: what all explanations leave counts as noise does.",
            "- Without the nominal refit: the rig file's values are taken for exact.",
            "- Without the levels: forces are looked for in the sum of all levels.",
            "- Without the noise model: white and coloured noise of each sensor alone, none that",
            "  comes through the rig.",
            "",
        ]
    )


def _width(n: int) -> float:
    """Half a 90 % interval of a share of a half."""
    half = frequency("", [i % 2 == 0 for i in range(n)])
    return (half.high - half.low) / 2


def picture(rows: Sequence[Row], path: Path) -> None:
    """Names and places right with everything and with less, a panel a curve."""
    own: dict[str, list[Row]] = defaultdict(list)
    for r in rows:
        own[r.case.curve].append(r)
    figure = Figure((WIDE, HIGH), layout="constrained")
    axes = figure.subplots(2, 3, sharey=True).ravel()
    for ax, curve in zip(axes, (*CURVES, OUT), strict=True):
        for name, colour, aside in (("name", "C0", -0.08), ("place", "C1", 0.08)):
            for which, marker in (("whole", "_"), ("less", "o")):
                each = [getattr(getattr(r, which), name) for r in own[curve]]
                y = np.array([s.value for s in each])
                x = np.arange(y.size) + aside
                if which == "whole":
                    ax.plot(x, y, marker, color=colour, markersize=14, markeredgewidth=2,
                            label=f"{name}, everything", linestyle="")  # fmt: skip
                    continue
                error = np.array([[s.value - s.low, s.high - s.value] for s in each]).T
                ax.errorbar(x, y, np.maximum(error, 0), fmt=marker, color=colour, capsize=3,
                            label=f"{name}, with less")  # fmt: skip
        ticks = [f"{r.case.at.removeprefix('the ')}\n({r.hidden})" for r in own[curve]]
        ax.set_xticks(range(len(ticks)), ticks, rotation=25 if curve == OUT else 0)
        ax.set_xlim(-0.5, len(ticks) - 0.5)
        ax.set_xlabel(SAID.get(curve, "taken out of the method"))
        ax.set_ylim(0, 1.02)
        ax.grid(alpha=0.3)
    axes[0].legend(fontsize="small")
    for ax in (axes[0], axes[3]):
        ax.set_ylabel("told right")
    figure.savefig(path, dpi=DPI)


def chosen_of(out: Path) -> tuple[list[Path], list[Path]]:
    """Folders of a campaign's trials that conceal one effect, and nothing, in an order that is as
    good as random."""
    hidden, nothing = [], []
    for file in (out / "outcomes").glob("*.json"):
        outcome = json.loads(file.read_text("utf-8"))
        folder = out / "recordings" / outcome.get("trial", "-")
        if "error" in outcome or not folder.exists() or outcome["seconds"]["diagnosis"] > SECONDS:
            continue
        truth = truth_of(out, folder.name)
        if truth.kind == "nothing":
            nothing.append(folder)
        elif truth.kind in ("one", "force") and FROM <= truth.size <= TO:
            hidden.append(folder)

    def mixed(some: list[Path]) -> list[Path]:
        return sorted(some, key=lambda f: hashlib.sha256(f.name.encode()).digest())

    return mixed(hidden), mixed(nothing)


def in_turn(hidden: Sequence[Path], nothing: Sequence[Path]) -> Iterator[Path]:
    """All of them, every `NULLS`th one that conceals nothing as long as there are such."""
    rest = iter(nothing)
    for n, folder in enumerate(hidden, 1):
        yield folder
        if n % (NULLS - 1) == 0 and (one := next(rest, None)) is not None:
            yield one
    yield from rest


def main() -> None:
    """Diagnose every chosen trial in every case; write the page and its picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, nargs="+", help="folders of trials with recordings")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no case later")
    parser.add_argument("--docs", type=Path, help="folder of the page, evidence/, and images/")
    parser.add_argument("--part", default="1/1", help="of every n trials the k-th alone, as k/n")
    chosen = parser.parse_args()
    mpl.use("Agg")
    each = [chosen_of(out) for out in chosen.out]
    hidden = [folder for some, _ in each for folder in some]
    nothing = [folder for _, some in each for folder in some]
    folders = list(in_turn(hidden, nothing))
    k, n = map(int, chosen.part.split("/"))
    until = time.monotonic() + 60 * chosen.minutes
    for at, folder in enumerate(folders):
        if at % n == k - 1:
            if not answered(folder, until):
                break
            print(f"{at + 1} of {len(folders)}", file=sys.stderr, flush=True)
    whole = [f for f in folders if all(kept_at(f, case).exists() for case in CASES)]
    kinds = [truth_of(f.parents[1], f.name).kind for f in whole]
    quiet = sum(kind == "nothing" for kind in kinds)
    if not quiet or quiet == len(whole):
        sys.exit(f"{len(whole)} trials have all answers: expected some of one effect, some of none")
    rows = [row for case in CASES[1:] if (row := Row.of(case, whole)) is not None]
    docs = chosen.docs or chosen.out[0]
    for file in (PAGE, PICTURE):
        (docs / file).parent.mkdir(parents=True, exist_ok=True)
    (docs / PAGE).write_text(page(rows, whole, quiet), encoding="utf-8")
    picture(rows, docs / PICTURE)
    print("\n".join(r.line() for r in rows))


if __name__ == "__main__":
    main()
