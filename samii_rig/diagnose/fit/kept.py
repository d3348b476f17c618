"""What was computed of the latest fits, and is asked for again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from samii_rig.diagnose.physics.aliases import Aliases
from samii_rig.types import Complex

T = TypeVar("T")
FITS = 16  # of which the sums over aliases are kept
# Of answers on contours that are kept: 256 MB, 16 of eight entries at full length.
NUMBERS_KEPT = 2**24


@dataclass(frozen=True)
class Latest(Generic[T]):
    """What was computed last, by what it was computed of: an array counts by its numbers, all else
    by one, and what has no room beside the latest goes."""

    room: int
    made: dict[Hashable, tuple[object, T]] = field(default_factory=dict)

    def get(self, key: Hashable, of: object, make: Callable[[], T]) -> T:
        """What was made of a key, or is now. of : objects whose `id` is in it."""
        if key not in self.made:
            self.made[key] = of, make()
            while len(self.made) > 1 and self._size > self.room:
                del self.made[next(iter(self.made))]
        return self.made[key][1]

    @property
    def _size(self) -> int:
        found = (one for _, one in self.made.values())
        return sum(one.size if isinstance(one, np.ndarray) else 1 for one in found)


@dataclass(frozen=True)
class Computed:
    """Of the latest fits: sums over aliases, and answers on contours."""

    aliases: Latest[Aliases] = field(default_factory=lambda: Latest(FITS))
    answers: Latest[Complex] = field(default_factory=lambda: Latest(NUMBERS_KEPT))
