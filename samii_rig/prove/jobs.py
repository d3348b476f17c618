"""Which trials a campaign has: kind and seed of each, its plant and its rig drawn by them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from samii_rig.errors import InputError, one_of
from samii_rig.installed import points

GROUP = "samii_rig.plants"
KINDS = ("nothing", "one", "two", "outside", "joints", "force", "varying")
_DRAW = 77  # of the generator that draws plant and rig: another stream than any plant's


class Plant(Protocol):
    """What an entry point of `samii_rig.plants` gives."""

    def __call__(self, kind: str, seed: int, out: Path, rig_toml: str) -> Path:
        """Make a trial, or find it made; returns the folder of its recordings."""

    def refuses(self, kind: str, rig_toml: str) -> str:
        """Why there is no trial of this kind with this rig; "" where there is."""


@dataclass(frozen=True, slots=True)
class Job:
    """One trial to be made and diagnosed: within a campaign kind and seed name it."""

    kind: str
    seed: int
    plant: str
    rig: str

    @property
    def name(self) -> str:
        """As the files of its outcome are called."""
        return f"{self.kind}_{self.seed}"


def plant(name: str) -> Plant:
    """The plant of this name.

    InputError for one that is not installed.
    """
    known = {point.name: point for point in points(GROUP)}
    if name not in known:
        raise InputError("samii-rig prove", "--plant", name, one_of(name, sorted(known)))
    loaded: Plant = known[name].load()
    return loaded


def plants() -> tuple[str, ...]:
    """Names of all plants that are installed."""
    return tuple(sorted({point.name for point in points(GROUP)}))


Pairs = Mapping[str, Sequence[tuple[str, str]]]
"""Of each kind the (plant, rig) that have trials of it."""


def pairs(
    names: Sequence[str],
    rigs: Mapping[str, str],
    kinds: Sequence[str] = KINDS,
    find: Callable[[str], Plant] = plant,
    asked: Collection[str] | None = None,
) -> tuple[Pairs, list[str]]:
    """Every plant with every rig (text by name) that it does not refuse, by kind, and in words each
    rig that a plant cannot make at all.

    asked : rigs that one must make; None for all. InputError for one of them that none can make.
    """
    found: dict[str, list[tuple[str, str]]] = {kind: [] for kind in kinds}
    left_out = []
    for name in names:
        made = find(name)
        for rig, text in rigs.items():
            why = {kind: made.refuses(kind, text) for kind in kinds}
            for kind, reason in why.items():
                if not reason:
                    found[kind].append((name, rig))
            if all(why.values()):
                left_out.append(f"{name} cannot make {rig}: {why[kinds[0]]}")
    for rig in rigs if asked is None else asked:
        if not any(rig == r for some in found.values() for _, r in some):
            raise InputError(
                "samii-rig prove", "--rig", rig, f"a rig that {' or '.join(names)} has"
            )
    return found, left_out


def jobs(counts: Mapping[str, int], seed: int, having: Pairs) -> list[Job]:
    """`counts` trials of each kind with seeds from `seed` on, kinds in turn, so that a campaign
    that is stopped early has some of each. Every pair of plant and rig is as likely as any other.

    InputError for a kind of which no pair has trials.
    """
    rows = []
    for kind in KINDS:
        n = counts.get(kind, 0)
        if n and not having.get(kind):
            raise InputError("samii-rig prove", f"--{kind}", n, "0: no plant has such trials here")
        rows.append([_drawn(kind, seed + i, having[kind]) for i in range(n)])
    place = [
        ((i + 0.5) / len(row), k, job) for k, row in enumerate(rows) for i, job in enumerate(row)
    ]
    return [job for _, _, job in sorted(place, key=lambda x: x[:2])]


def _drawn(kind: str, seed: int, some: Sequence[tuple[str, str]]) -> Job:
    rng = np.random.default_rng([seed, KINDS.index(kind), _DRAW])
    name, rig = some[int(rng.integers(len(some)))]
    return Job(kind, seed, name, rig)
