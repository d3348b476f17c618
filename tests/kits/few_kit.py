"""A vocabulary of few effects, for tests of what stands around a diagnosis."""

from __future__ import annotations

import pytest

import samii_rig.diagnose.diagnose as room


def only(monkeypatch: pytest.MonkeyPatch, *names: tuple[str, str]) -> None:
    """Diagnoses try these (physics, site) alone: the whole vocabulary takes a minute."""
    table = room.table
    monkeypatch.setattr(
        room,
        "table",
        lambda *a, **more: [e for e in table(*a, **more) if {*names} & {*e.names}],
    )
