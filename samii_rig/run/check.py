"""One thing that was looked at at the bench, and the remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "look", "bad"]


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was looked at; `remedy` is "" where nothing is to be done."""

    what: str
    verdict: Verdict
    found: str
    remedy: str = ""

    @classmethod
    def failed(cls, what: str, error: Exception) -> Check:
        """An error's line: what was found and, after the last semicolon, what to do."""
        found, _, remedy = str(error).rpartition("; ")
        return cls(
            what, "bad", found or remedy, remedy if found else "see docs/reference/drivers.md"
        )
