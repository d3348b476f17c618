"""What came of every trial, as plain data: from a campaign's folder, or from the file kept of one.

An outcome has `kind`, `seed`, `plant`, `rig`, `seconds` (process time by part), the truth
(`effects`, `size`, `size_is`, `twins`, `styles`, `truth_sha256`) and `answer`, as far as scores and
calibration look at it; or `error` and `at`, the part that failed.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from samii_rig.diagnose.fit.stated import Evidence
from samii_rig.errors import InputError
from samii_rig.files import reason
from samii_rig.prove.calibrate import places, row
from samii_rig.prove.jobs import KINDS
from samii_rig.prove.trial import REFUSED, Answer, Trial, Truth
from samii_rig.record.export import replacing

DIGITS = 5  # significant ones that are kept of a number
KEPT = ("verdict", "why", "causes", "sites", "mismatch", "used", "moved", "not_physics")
Outcome = Mapping[str, Any]


def collected(out: Path) -> tuple[dict[str, Any], list[Outcome]]:
    """What a campaign's folder was made of, and every outcome in it, by kind and seed."""
    file = out / "campaign.json"
    made = json.loads(file.read_text("utf-8")) if file.exists() else {}
    return made, _sorted(_each(out))


def _sorted(some: Iterator[Outcome]) -> list[Outcome]:
    return sorted(some, key=lambda o: (KINDS.index(o["kind"]), o["seed"]))


def _each(out: Path) -> Iterator[Outcome]:
    for file in (out / "outcomes").glob("*.json"):
        outcome = json.loads(file.read_text("utf-8"))
        if "error" in outcome:
            yield outcome
            continue
        name = f"{outcome['trial']}.json"
        answer = json.loads((out / "answers" / name).read_text("utf-8"))
        yield {**outcome, **_hidden(out, name), "answer": _answer(answer)}


def _hidden(out: Path, name: str) -> dict[str, Any]:
    truth = json.loads((out / "truth" / name).read_text("utf-8"))
    return {**_truth(truth), **json.loads((out / "sizes" / name).read_text("utf-8"))}


def truth_of(out: Path, trial: str) -> Truth:
    """What a trial of this name conceals, at the size that a refit leaves of it."""
    name = f"{trial}.json"
    truth = json.loads((out / "truth" / name).read_text("utf-8"))
    return Truth.of({"kind": truth["kind"], "seed": truth["seed"], **_hidden(out, name)})


def _truth(truth: Mapping[str, Any]) -> dict[str, Any]:
    keys = ("physics", "site", "parameters", "also", "position")
    effects = [{k: e[k] for k in keys if e.get(k) is not None} for e in truth["effects"]]
    # The first plant has one style: bursts that ring down, multisines and steps beside them.
    return {
        "effects": effects,
        "size_is": "bursts" if truth.get("size_is") != "whole records" else "whole records",
        "styles": truth.get("styles", ["bursts, multisines, steps"]),
    }


def _answer(answer: Mapping[str, Any]) -> dict[str, Any]:
    kept = {k: answer[k] for k in KEPT if k in answer}
    kept["fit"] = {"gap_closed": answer["fit"].get("gap_closed")}
    if "mismatch" in kept:
        kept["mismatch"] = {k: v for k, v in kept["mismatch"].items() if k != "bands"}
    return {**kept, "evidence": answer["evidence"]}


def trials(outcomes: Sequence[Outcome]) -> list[Trial]:
    """All that have an answer."""
    return [
        Trial(Truth.of(o), Answer.of(o["answer"]), o["seconds"].get("diagnosis", 0.0))
        for o in outcomes
        if "error" not in o
    ]


Rows = list[tuple[Evidence, bool]]


def evidence(outcomes: Sequence[Outcome]) -> tuple[Rows, list[str], Rows, list[str]]:
    """Of every trial in which an effect was found its evidence and whether it was right, with the
    group that each is of, plant and excitation; the same of each cause's place."""
    answers: Rows = []
    sites: Rows = []
    of_answers, of_sites = [], []
    for o in outcomes:
        if "error" in o or o["answer"]["verdict"] == REFUSED:
            continue
        truth, group = Truth.of(o), f"{o['plant']}, {o['styles'][0]}"
        if (found := row(truth, o["answer"])) is not None:
            answers.append(found)
            of_answers.append(group)
        more = places(truth, o["answer"])
        sites += more
        of_sites += [group] * len(more)
    return answers, of_answers, sites, of_sites


def write(path: Path, made: Mapping[str, Any], outcomes: Sequence[Outcome]) -> None:
    """Keep all outcomes in one compressed file (.jsonl.xz), numbers to `DIGITS` digits."""
    lines = [json.dumps(_short(x), separators=(",", ":")) for x in (made, *outcomes)]
    with replacing(path) as part:
        part.write_bytes(lzma.compress("\n".join(lines).encode(), preset=9 | lzma.PRESET_EXTREME))


def _short(x: Any) -> Any:
    if isinstance(x, float):
        return float(f"{x:.{DIGITS}g}")
    if isinstance(x, Mapping):
        return {k: _short(v) for k, v in x.items()}
    return [_short(v) for v in x] if isinstance(x, list | tuple) else x


def read(path: Path) -> tuple[dict[str, Any], list[Outcome]]:
    """What `write` kept.

    InputError for a file that is none of those.
    """
    try:
        text = lzma.decompress(path.read_bytes()).decode()
        made, *rest = (json.loads(line) for line in text.splitlines())
        return made, _sorted(iter(rest))
    except OSError as error:
        raise InputError.saying(str(path), "", f"cannot be read: {reason(error)}") from error
    except (lzma.LZMAError, ValueError, KeyError) as error:
        said = "is no file of outcomes; expected one that prove --page wrote (.jsonl.xz)"
        raise InputError.saying(str(path), "", said) from error
