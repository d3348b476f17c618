"""The one operator who drives, as long as they give signs of life."""

from __future__ import annotations

import hmac
import math
import secrets
import time
from collections.abc import Callable

from samii_rig.errors import GateError

EVERY = 2.0  # s between signs of life that a client is asked for
LASTS = 10.0  # s without one after which the lease, and the run that it drives, ends


class Lease:
    """At most one at a time. clock : s, monotonic."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._secret = self.holder = ""
        self._until = -math.inf

    def take(self, person: str) -> str:
        """The lease for this person, as a secret to show with every command.

        GateError while another has it.
        """
        if self.alive:
            raise GateError(f"{self.holder} drives; expected them to hand over, or to go silent")
        self._secret, self.holder = secrets.token_urlsafe(16), person
        self._until = self._clock() + LASTS
        return self._secret

    def beat(self, secret: str) -> None:
        """A sign of life; GateError if this is not the lease."""
        self.check(secret)
        self._until = self._clock() + LASTS

    def check(self, secret: str) -> None:
        """GateError unless this is the lease."""
        if not self.holds(secret):
            held = f"{self.holder} drives" if self.alive else "nobody drives"
            raise GateError(f"not your lease: {held}; expected POST /api/lease first")

    def holds(self, secret: str) -> bool:
        """Whether this is the lease; compared in constant time."""
        return self.alive and hmac.compare_digest(secret.encode(), self._secret.encode())

    def give_back(self, secret: str) -> None:
        """End it in good order: what runs goes on."""
        self.check(secret)
        self._secret = self.holder = ""

    @property
    def alive(self) -> bool:
        """Somebody has it and gives signs of life."""
        return bool(self._secret) and self._clock() < self._until

    def lost(self) -> str:
        """Who has gone silent since this was asked last; "" if nobody."""
        if self._secret and not self.alive:
            gone, self._secret, self.holder = self.holder, "", ""
            return gone
        return ""
