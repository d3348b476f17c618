"""What data a diagnosis needs, and what each part of the method buys.

    samii-rig prove --keep --plant concealed --rig samii --nothing 100 --one 100 --two 0 \\
        --outside 0 --joints 0 --force 0 --varying 0 --out kept
    python benchmarks/data_needed.py kept

makes kept/data-needed.md and its picture beside it. The swept sines of each kept
trial are diagnosed with less: more noise, fewer channels, levels and repeats, a shorter part of
each sweep; and with one part of the method taken out. Every row is of the same trials, so that rows
compare. Answers are kept in OUT/needed and not made again: with --minutes it stops there, and the
page is of the trials that have all answers. OPENBLAS_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import patch

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.diagnose.fit.record_search import RecordSearch
from samii_rig.diagnose.fit.records import Whole
from samii_rig.diagnose.fit.refit import Fitted
from samii_rig.errors import SamiiRigError
from samii_rig.likelihood.noise import Disturbances
from samii_rig.plain import plain
from samii_rig.prove.outcomes import truth_of
from samii_rig.prove.score import Score, confidently_wrong, frequency
from samii_rig.prove.trial import Answer, Trial
from samii_rig.record.export import replacing
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import parameters
from samii_rig.signal.columns import centring_of
from samii_rig.signal.estimate import estimate
from samii_rig.types import Complex, Float, Recording, Segment

FROM = 10.0  # sigma that a refit leaves in the whole data, from which an effect should be found
PAGE, PICTURE = "data-needed.md", "data-needed.png"
WIDE, HIGH, DPI = 11.0, 6.0, 110  # inches of the picture, and dots per inch

Recordings = Sequence[Recording]
Less = Callable[[Recordings, Rig], list[Recording]]


def noisier(factor: float) -> Less:
    """White noise, so that each sensor's own is `factor` times as large as the rig file says.

    The command has what the loop makes of it, so that the loop's law holds: the input r = v + kp
    theta stays, and what the rig would have answered to it (kp K is 2 rad/s) is left out.
    """

    def change(runs: Recordings, rig: Rig) -> list[Recording]:
        rng = np.random.default_rng(7)
        out = []
        for run in runs:
            values = run.values.copy()
            added: dict[str, Float] = {}
            for s in rig.sensor:
                rms = np.sqrt((factor**2 - 1) * (s.noise_rms**2 + s.resolution**2 / 12))
                added[s.name] = rms * rng.normal(size=len(values))
                values[:, run.column(s.name)] += added[s.name]
            loop = centring_of(run)
            if loop is not None:
                (command,) = run.names("command")
                values[:, run.column(command)] -= loop[1] * added[loop[0]]
            out.append(replace(run, values=values))
        return out

    return change


def only(*names: str) -> Less:
    """These sensors alone."""

    def change(runs: Recordings, _: Rig) -> list[Recording]:
        out = []
        for run in runs:
            kept = [i for i, c in enumerate(run.channels) if c.role != "sensor" or c.name in names]
            channels = tuple(run.channels[i] for i in kept)
            values, quality = run.values[:, kept], run.quality[:, kept]
            out.append(replace(run, channels=channels, values=values, quality=quality))
        return out

    return change


def segments(keep: Callable[[Sequence[Segment], Segment], Segment | None]) -> Less:
    """Of each recording the segments that `keep` gives back, of all recordings' segments and
    one."""

    def change(runs: Recordings, _: Rig) -> list[Recording]:
        every = [s for run in runs for s in run.segments]
        out = []
        for run in runs:
            kept = tuple(s for one in run.segments if (s := keep(every, one)) is not None)
            if kept:
                out.append(replace(run, segments=kept))
        return out

    return change


def highest(n: int) -> Less:
    """The n highest levels."""

    def keep(every: Sequence[Segment], one: Segment) -> Segment | None:
        return one if one.level in sorted({s.level for s in every})[-n:] else None

    return segments(keep)


def first(n: int) -> Less:
    """The first n repeats of each level."""
    return segments(lambda _, one: one if one.repeat < n else None)


def shorter(part: float) -> Less:
    """The first part of each sweep, which ends there while the rig still moves."""

    def keep(_: Sequence[Segment], one: Segment) -> Segment | None:
        return replace(one, kind="single", stop=one.start + round(part * (one.stop - one.start)))

    return segments(keep)


def same(runs: Recordings, _: Rig) -> list[Recording]:
    """As they are."""
    return list(runs)


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
def _replaced(of: type, **names: object) -> Iterator[None]:
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
        return f"{self.curve} {self.at}".replace(" ", "_").replace("/", "_")


ALL = Case("everything", "")
CURVES = ("noise", "channels", "levels", "length", "repeats")
OUT = "without"
CASES = (
    ALL,
    Case("noise", "x 3", noisier(3.0)),
    Case("noise", "x 10", noisier(10.0)),
    Case("channels", "2", only("theta_2", "a_2")),
    Case("channels", "1", only("theta_2")),
    Case("levels", "2", highest(2)),
    Case("levels", "1", highest(1)),
    Case("length", "3/4", shorter(0.75)),
    Case("length", "1/2", shorter(0.5)),
    Case("repeats", "2", first(2)),
    Case("repeats", "1", first(1)),
    Case(OUT, "the transient", whole=False),
    Case(OUT, "the discrepancy",
         without=lambda: _replaced(RecordSearch, overdispersion_of=lambda _self, _fitted: 1.0)),
    Case(OUT, "the nominal refit", held=certain),
    Case(OUT, "the levels", without=lambda: _replaced(Whole, by_level=lambda self: self)),
    Case(OUT, "the noise model", without=lambda: _replaced(Whole, disturbed=_alone)),
)  # fmt: skip
WHOLE = {"noise": "x 1", "channels": "4", "levels": "3", "length": "1", "repeats": "4"}
SAID = {
    "noise": "sensors' noise, of the rig file's",
    "channels": "sensors",
    "levels": "levels",
    "length": "part of each sweep",
    "repeats": "repeats",
}


def kept_at(folder: Path, case: Case) -> Path:
    """The file of an answer."""
    return folder.parents[1] / "needed" / case.key / f"{folder.name}.json"


def answered(folder: Path, until: float) -> bool:
    """Diagnose one trial in the cases that have no answer yet, each kept as soon as it is there;
    whether all have one."""
    runs = [read_recording(log) for log in sorted(folder.glob("swept_sine*.mcap"))]
    rig = parse(Rig, runs[0].rig_toml, str(folder))
    for case in CASES:
        kept = kept_at(folder, case)
        if kept.exists():
            continue
        if time.monotonic() > until:
            return False
        own = case.less(runs, rig)
        try:
            with case.without():
                responses = estimate(own)
                found = diagnose(responses, case.held(rig), runs=own if case.whole else ())
            said = plain(found.plain())
        except SamiiRigError as error:
            said = {"failed": str(error)}
        kept.parent.mkdir(parents=True, exist_ok=True)
        with replacing(kept) as part:
            part.write_text(json.dumps(said), encoding="utf-8")
    return True


REFUSAL = {"verdict": "refused", "causes": [], "sites": [], "fit": {}}


def trial_of(folder: Path, case: Case) -> Trial:
    """The trial with its answer."""
    said = json.loads(kept_at(folder, case).read_text("utf-8"))
    if "failed" in said:
        print(f"{folder.name} {case.key}: {said['failed']}", file=sys.stderr, flush=True)
        said = REFUSAL
    return Trial(truth_of(folder.parents[1], folder.name), Answer.of(said))


@dataclass(frozen=True, slots=True)
class Row:
    """What came of a case."""

    case: Case
    alarms: Score
    place: Score
    name: Score
    wrong: Score
    kept: float

    @classmethod
    def of(cls, case: Case, folders: Sequence[Path]) -> Row:
        """Over all trials."""
        trials = [trial_of(f, case) for f in folders]
        nothing = [t for t in trials if t.truth.kind == "nothing"]
        big = [t for t in trials if t.truth.kind == "one" and t.truth.size >= FROM]
        kept = [t.answer.sigma / t.truth.size for t in big if t.right]
        return cls(
            case,
            frequency("", [t.answer.verdict != "no_mismatch" for t in nothing]),
            frequency("", [t.place_right for t in big]),
            frequency("", [t.right for t in big]),
            frequency("", [confidently_wrong(t) for t in trials]),
            statistics.median(kept) if kept else float("nan"),
        )

    def line(self) -> str:
        """Of the page's table."""
        cells = [f"{c.value:.0%} ({c.low:.0%} to {c.high:.0%})"
                 for c in (self.alarms, self.place, self.name, self.wrong)]  # fmt: skip
        what = f"{self.case.curve} {self.case.at}".strip()
        kept = f"{self.kept:.2f}" if self.kept == self.kept else ""
        return f"| {what} | {' | '.join(cells)} | {kept} |"


def page(rows: Sequence[Row], nothing: int, one: int) -> str:
    """The tables, with how they were made."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    return "\n".join(
        [
            "# What data a diagnosis needs\n",
            f"Made at commit {commit} by `python benchmarks/data_needed.py kept`, of {one} trials",
            f"of the first plant that conceal one effect of {FROM:g} sigma or more, and {nothing}",
            "that conceal nothing. Each has three levels of four swept sines of 36 s on SAMII,",
            "read by four sensors. A row changes one thing and keeps the rest. Intervals are 90 %.",
            f"With {one} trials a share is known to some {_width(one):.0%} either way. Only what",
            "is larger than that counts.\n",
            "![Effects told right, by what the recordings have](data-needed.png)\n",
            "| recordings or method | missing where nothing is | place right | name right | "
            "confidently wrong | sigma kept, named right |",
            "|---|---|---|---|---|---|",
            *(r.line() for r in rows),
            "",
            "- `noise`: white noise is added to each sensor, and to the command what the loop",
            "  makes of it.",
            "- `channels`: theta_2 and a_2, and theta_2 alone.",
            "- `length`: each sweep ends there, while the rig moves; the band above is lost too.",
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
    """Names right, a panel a curve and one of the parts taken out."""
    own: dict[str, list[Row]] = defaultdict(list)
    for r in rows:
        own[r.case.curve].append(r)
    whole = own["everything"][0]
    figure = Figure((WIDE, HIGH), layout="constrained")
    axes = figure.subplots(2, 3, sharey=True).ravel()
    for ax, curve in zip(axes, (*CURVES, OUT), strict=True):
        points = [(WHOLE.get(curve, "nothing"), whole), *((r.case.at, r) for r in own[curve])]
        for score, label, colour in (("name", "name", "C0"), ("place", "place", "C1")):
            each = [getattr(r, score) for _, r in points]
            y = np.array([s.value for s in each])
            error = np.array([[s.value - s.low for s in each], [s.high - s.value for s in each]])
            x = np.arange(len(points)) + (0.06 if score == "place" else -0.06)
            style = "o-" if curve != OUT else "o"
            ax.errorbar(x, y, np.maximum(error, 0), fmt=style, color=colour, label=label, capsize=3)
        ticks = [at.removeprefix("the ") for at, _ in points]
        ax.set_xticks(range(len(points)), ticks, rotation=20 if curve == OUT else 0)
        ax.set_xlabel(SAID.get(curve, "taken out of the method"))
        ax.set_ylim(0, 1.02)
        ax.grid(alpha=0.3)
    axes[0].legend()
    axes[0].set_ylabel("told right")
    axes[3].set_ylabel("told right")
    figure.savefig(path, dpi=DPI)


def main() -> None:
    """Diagnose every kept trial in every case; write the page and its picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of trials with their recordings")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no case later")
    chosen = parser.parse_args()
    mpl.use("Agg")
    folders = [
        p for p in sorted((chosen.out / "recordings").iterdir()) if list(p.glob("swept_sine*.mcap"))
    ]
    until = time.monotonic() + 60 * chosen.minutes
    whole = []
    for n, folder in enumerate(folders, 1):
        if not answered(folder, until):
            break
        whole.append(folder)
        print(f"{n} of {len(folders)}", file=sys.stderr, flush=True)
    truths = [truth_of(chosen.out, f.name) for f in whole]
    nothing = sum(t.kind == "nothing" for t in truths)
    one = sum(t.kind == "one" and t.size >= FROM for t in truths)
    if not one or not nothing:
        sys.exit(f"{len(whole)} trials have all answers: expected some of one effect, some of none")
    rows = [Row.of(case, whole) for case in CASES]
    (chosen.out / PAGE).write_text(page(rows, nothing, one), encoding="utf-8")
    picture(rows, chosen.out / PICTURE)
    print("\n".join(r.line() for r in rows))


if __name__ == "__main__":
    main()
