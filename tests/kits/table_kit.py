"""Tables of effects for the tests of the diagnosis, each made once in a process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, overload

from samii_rig.diagnose.diagnose import table
from samii_rig.diagnose.physics.effect import Effect
from samii_rig.rig.schema import Rig

_MADE: dict[tuple[str, str], list[Effect]] = {}


def table_of(rig: Rig, low_hz: float, high_hz: float, *physics: str, **more: Any) -> list[Effect]:
    """The rig's table, or its effects of some physics; 0.3 s for SAMII, the first time."""
    key = rig.model_dump_json(), repr((low_hz, high_hz, more))
    if key not in _MADE:
        _MADE[key] = table(rig, low_hz, high_hz, **more)
    return [e for e in _MADE[key] if not physics or e.physics in physics]


class Effects(Sequence[Effect]):
    """What `made` gives, made when a test first looks: five processes collect the tests."""

    def __init__(self, made: Callable[[], Sequence[Effect]]) -> None:
        self._made = made

    @cached_property
    def _all(self) -> Sequence[Effect]:
        return self._made()

    @overload
    def __getitem__(self, i: int) -> Effect: ...
    @overload
    def __getitem__(self, i: slice) -> Sequence[Effect]: ...
    def __getitem__(self, i: int | slice) -> Effect | Sequence[Effect]:
        return self._all[i]

    def __len__(self) -> int:
        return len(self._all)
