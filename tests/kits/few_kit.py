"""A vocabulary of few effects, for tests of what stands around a diagnosis."""

from __future__ import annotations

import pytest

import samii_rig.diagnose.diagnose as room
from samii_rig.diagnose.forces import fits


def only(monkeypatch: pytest.MonkeyPatch, *names: tuple[str, str], forced: bool = True) -> None:
    """Diagnoses try these (physics, site) alone: the whole vocabulary takes a minute. forced : and
    every force that the rig may have, which takes half of what is left."""
    table = room.table
    if not forced:
        monkeypatch.setattr(fits, "forces", lambda *_: [])
    monkeypatch.setattr(
        room,
        "table",
        lambda *a, **more: [e for e in table(*a, **more) if {*names} & {*e.names}],
    )
