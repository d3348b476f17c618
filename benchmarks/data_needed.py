"""How much data a diagnosis needs, and what each part of it buys.

    samii-rig prove --keep --plant concealed --rig samii --nothing 6 --one 28 --two 0 --outside 0 \\
        --joints 0 --force 0 --out kept
    python benchmarks/data_needed.py kept --workers 2

Each kept trial is diagnosed again with less: more noise, fewer channels, one level, shorter runs;
and with a part of the method taken out: the nominal parameters held at their values, the covariance
of the channels taken for diagonal, all levels taken for one. Every row is of the same trials, so
that rows compare. Noise is added to the responses in proportion to their own covariance, which is
what longer averaging takes away.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path

import numpy as np

from samii_rig.diagnose.diagnose import diagnose
from samii_rig.errors import SamiiRigError
from samii_rig.plain import plain
from samii_rig.prove.outcomes import truth_of
from samii_rig.prove.score import confidently_wrong, frequency
from samii_rig.prove.trial import Answer, Trial
from samii_rig.record.export import replacing
from samii_rig.record.reader import read_recording
from samii_rig.rig.load import parse
from samii_rig.rig.schema import Rig
from samii_rig.rig.schema.elements import parameters
from samii_rig.signal.estimate import estimate
from samii_rig.types import FrequencyResponse, Recording
from samii_rig.workers import workers

FROM = 10.0  # sigma that a refit leaves in the whole data, from which an effect should be found
Responses = list[FrequencyResponse]


def noisier(factor: float) -> Callable[[Responses], Responses]:
    """Standard deviation of the noise `factor` times as large."""

    def change(responses: Responses) -> Responses:
        rng = np.random.default_rng(7)
        out = []
        for r in responses:
            more = (factor**2 - 1) * r.covariance
            values, vectors = np.linalg.eigh(more)
            root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
            e = rng.normal(size=(2, *r.H.reshape(r.H.shape[0], -1).shape)) / np.sqrt(2)
            dH = (root @ (e[0] + 1j * e[1])[:, :, None])[:, :, 0]
            H = r.H + dH.reshape(r.H.shape)
            out.append(replace(r, H=H, covariance=factor**2 * r.covariance))
        return out

    return change


def only(*names: str) -> Callable[[Responses], Responses]:
    """These sensors alone."""

    def change(responses: Responses) -> Responses:
        out = []
        for r in responses:
            on = [i for i, c in enumerate(r.outputs) if c.name in names]
            out.append(
                replace(
                    r,
                    H=r.H[:, on],
                    covariance=r.covariance[:, on][:, :, on],
                    coherence=r.coherence[:, on],
                    outputs=tuple(r.outputs[i] for i in on),
                    even=None if r.even is None else r.even[:, on],
                    odd=None if r.odd is None else r.odd[:, on],
                )
            )
        return out

    return change


def highest(responses: Responses) -> Responses:
    """The highest level alone."""
    top = max(r.level for r in responses)
    return [r for r in responses if r.level == top]


def diagonal(responses: Responses) -> Responses:
    """Channels taken for independent."""
    eye = np.eye(responses[0].covariance.shape[1])
    return [replace(r, covariance=r.covariance * eye) for r in responses]


def one_level(responses: Responses) -> Responses:
    """Every response said to be of one and the same level."""
    return [replace(r, level=1.0) for r in responses]


def certain(rig: Rig) -> Rig:
    """The rig without tolerances: nothing is refitted."""
    elements = tuple(
        e.model_copy(
            update={s: p.model_copy(update={"tolerance": 0.0}) for s, p in parameters(e).items()}
        )
        for e in rig.element
    )
    return rig.model_copy(update={"element": elements})


def shorter(recordings: Sequence[Recording]) -> list[Recording]:
    """Half of each run's segments."""
    return [
        replace(r, segments=r.segments[: max(2, (len(r.segments) + 1) // 2)]) for r in recordings
    ]


def same(responses: Responses) -> Responses:
    """As they are."""
    return responses


CASES: dict[str, Callable[[Responses], Responses]] = {
    "everything": same,
    "noise x 3": noisier(3.0),
    "noise x 10": noisier(10.0),
    "theta_2 and a_2": only("theta_2", "a_2"),
    "theta_2 alone": only("theta_2"),
    "highest level alone": highest,
    "half the bursts": same,
    "without: nominal refit": same,
    "without: covariance of channels": diagonal,
    "without: levels kept apart": one_level,
}


def answered(folder: Path, cases: Sequence[str]) -> None:
    """Diagnose one trial in those of `cases` that have no answer yet; each is kept in
    OUT/needed/CASE/TRIAL.json as soon as it is there."""
    todo = [case for case in cases if not kept_at(folder, case).exists()]
    if not todo:
        return
    recordings = [read_recording(log) for log in sorted(folder.glob("*.mcap"))]
    rig = parse(Rig, recordings[0].rig_toml, str(folder))
    whole: Responses = []
    for case in todo:
        kept = kept_at(folder, case)
        runs, own = recordings, rig
        if case == "half the bursts":
            runs = shorter(recordings)
            responses = list(estimate(runs))
        else:
            whole = whole or list(estimate(recordings))
            responses = CASES[case](whole)
        if case == "without: nominal refit":
            own = certain(rig)
        try:
            said = plain(diagnose(responses, own, runs=runs).plain())
        except SamiiRigError as error:
            said = {"failed": str(error)}
        kept.parent.mkdir(parents=True, exist_ok=True)
        with replacing(kept) as part:
            part.write_text(json.dumps(said), encoding="utf-8")


def kept_at(folder: Path, case: str) -> Path:
    """The file of an answer."""
    return (
        folder.parents[1]
        / "needed"
        / case.replace(": ", "_").replace(" ", "_")
        / f"{folder.name}.json"
    )


def trial_of(folder: Path, case: str) -> Trial | None:
    """The trial with its answer, None if the diagnosis said that it has nothing to go by."""
    said = json.loads(kept_at(folder, case).read_text("utf-8"))
    if "failed" in said:
        print(f"{folder.name} {case}: {said['failed']}", flush=True)
        return None
    return Trial(truth_of(folder.parents[1], folder.name), Answer.of(said))


def main() -> None:
    """Diagnose every kept trial in every case; print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of trials with their recordings")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    chosen = parser.parse_args()
    folders = sorted(p for p in (chosen.out / "recordings").iterdir() if list(p.glob("*.mcap")))
    with workers(chosen.workers) as pool:
        done = [pool.submit(answered, f, chosen.cases) for f in folders]
        for n, one in enumerate(as_completed(done), 1):
            one.result()
            print(f"{n} of {len(folders)}", file=sys.stderr, flush=True)
    head = ("false alarms", "detected", "place", "name", "confidently wrong")
    print(f"{'':33}" + " ".join(f"{h:>20}" for h in head))
    for case in chosen.cases:
        trials = [t for f in folders if (t := trial_of(f, case)) is not None]
        nothing = [t for t in trials if t.truth.kind == "nothing"]
        big = [t for t in trials if t.truth.kind == "one" and t.truth.size >= FROM]
        cells = [
            frequency("", [t.answer.verdict != "no_mismatch" for t in nothing]),
            frequency("", [t.answer.verdict != "no_mismatch" for t in big]),
            frequency("", [t.place_right for t in big]),
            frequency("", [t.right for t in big]),
            frequency("", [confidently_wrong(t) for t in trials]),
        ]
        text = [f"{c.value:4.0%} ({c.low:.0%} to {c.high:.0%})" for c in cells]
        print(
            f"{case:33}" + " ".join(f"{t:>20}" for t in text) + f"  n = {len(nothing)}, {len(big)}"
        )


if __name__ == "__main__":
    main()
