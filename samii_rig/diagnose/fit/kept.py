"""What was computed of the latest fits, and is asked for again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from samii_rig.diagnose.physics.aliases import Aliases
from samii_rig.types import Complex

T = TypeVar("T")
KEPT = 16  # fits of which the sums over aliases, and answers on contours, are kept
LONGEST_KEPT = 2**20  # numbers of an answer that is kept: 16 of them are 256 MB


@dataclass(frozen=True)
class Latest(Generic[T]):
    """What was computed last, by what it was computed of; no more than `KEPT`."""

    made: dict[Hashable, tuple[object, T]] = field(default_factory=dict)

    def get(self, key: Hashable, of: object, make: Callable[[], T]) -> T:
        """What was made of a key, or is now. of : objects whose `id` is in it."""
        if key not in self.made:
            found = make()
            if isinstance(found, np.ndarray) and found.size > LONGEST_KEPT:
                return found
            while len(self.made) >= KEPT:
                self.made.pop(next(iter(self.made)), None)
            self.made[key] = of, found
        return self.made[key][1]


@dataclass(frozen=True)
class Computed:
    """Of the latest fits: sums over aliases, and answers on contours."""

    aliases: Latest[Aliases] = field(default_factory=Latest)
    answers: Latest[Complex] = field(default_factory=Latest)
