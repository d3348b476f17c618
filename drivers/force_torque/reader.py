"""Asking the sensor for samples, in a thread: whatever ends it is an event, not silence.

A sample is one request and exactly the two frames of its reply, in order. Any other frame on
the sensor's identifiers comes from somebody else, and nothing tells whose of two frames is the
sensor's: it is refused with the sample in the making, and counted.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

import can

from drivers.force_torque.bus import send
from drivers.force_torque.frames import SAMPLE, Frames, Gauges
from samii_rig.errors import DeviceError

ANSWER_WITHIN = 0.25  # s, of a question before the samples begin
TRIES = 3
GIVE_UP = 20_000_000  # ns after which a request has no reply any more
# What is asked after a lost reply: what comes before its answer is late. Where that stays out too,
# another is asked: the answer to an earlier one says nothing of what was asked after it.
SYNCS = ("SerialNumber", "Firmware", "CountsPerUnit", "Units")
HANG = 1.0  # s without a turn of the thread after which it hangs
QUIET = 4  # of a period goes by after a reply before the next request
SAMPLES_KEPT = 65_536  # samples that wait for read()


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample: number of its request, host's monotonic time of the request and of the first
    frame of its reply, ns, and what it said."""

    number: int
    asked: int
    answered: int
    gauges: Gauges


@dataclass(slots=True)
class Counts:
    """Of requests and frames: `lost` requests had no reply, `foreign` frames were on the sensor's
    identifiers and not its reply, `late` ones came after their request was given up, `others` were
    of other identifiers, `corrupt` none at all, `slow` replies do not tell when."""

    requests: int = 0
    replies: int = 0
    lost: int = 0
    foreign: int = 0
    late: int = 0
    others: int = 0
    corrupt: int = 0
    slow: int = 0


class Reader:
    """Questions first, from whoever calls; then `start` and samples at the period.

    samples : readings that nobody took yet. trouble : why no more will come, "" while all is
    well. slowest : ns from a request to the first frame of its reply, beyond which a reply is left
    out. round_trips : ns, those of the others so far, their sum and number.
    """

    def __init__(self, bus: can.BusABC, frames: Frames, period: int) -> None:
        self.samples: deque[Reading] = deque(maxlen=SAMPLES_KEPT)
        self.counts = Counts()
        self.trouble = ""
        self.slowest = GIVE_UP
        self.round_trips = (0, 0)
        self._bus, self._frames, self._period = bus, frames, period
        self._asked = self._answered = self._due = 0
        self._pending = False
        self._first: bytes | None = None
        self._whole: Reading | None = None
        # The question whose answer ends what is late, "" for none; and of each of them how often it
        # was asked whose answer may still come.
        self._syncing, self._syncs = "", dict.fromkeys(SYNCS, 0)
        self._turn = time.monotonic()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reader of the CAN bus", daemon=True)

    @property
    def name(self) -> str:
        """Of the bus, for messages."""
        return str(self._bus.channel_info)

    def ask(self, *messages: str, data: bytes = b"") -> list[bytes]:
        """The data of a reply in these messages; DeviceError if it does not come."""
        for tried in range(TRIES):
            send(self._bus, self._frames.identifier(messages[0]), data)
            until = time.monotonic() + ANSWER_WITHIN
            replies: list[bytes] = []
            while len(replies) < len(messages) and time.monotonic() < until:
                frame = self._receive(max(0.0, until - time.monotonic()))
                if frame is None:
                    continue
                if not self._frames.ours(frame.arbitration_id):
                    self.counts.others += 1
                elif self._fits(frame, messages[len(replies)]):
                    replies.append(bytes(frame.data))
            if len(replies) == len(messages):
                if tried:
                    self._clear()
                return replies
        raise DeviceError(self._silent(messages[0]))

    def _clear(self) -> None:
        """Let pass what still comes: the answer to an earlier try would pass for that to the next
        question, as the rows of the matrix have the same identifiers."""
        until = time.monotonic() + ANSWER_WITHIN
        while (left := until - time.monotonic()) > 0:
            self._receive(left)

    def start(self) -> None:
        """Begin to sample."""
        self._due = time.monotonic_ns()
        self._turn = time.monotonic()
        self._thread.start()

    def check(self) -> None:
        """DeviceError if no more samples will come."""
        if not self.trouble and self._thread.ident is not None and not self._ending.is_set():
            if not self._thread.is_alive():
                self.trouble = f"{self.name}: the reader has ended"
            elif time.monotonic() - self._turn > HANG:
                self.trouble = f"{self.name}: the reader hangs"
        if self.trouble:
            raise DeviceError(self.trouble)

    def close(self) -> None:
        """End the thread."""
        self._ending.set()
        if self._thread.ident is not None:
            self._thread.join(2 * HANG)

    # The thread

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                self._turn = time.monotonic()
                now = time.monotonic_ns()
                busy = self._pending or bool(self._syncing)
                wait = GIVE_UP if busy else max(self._due - now, 0)
                frame = self._receive(min(wait, self._period) * 1e-9)
                if frame is not None:
                    self._take(frame, time.monotonic_ns())
                    if self.trouble:
                        return
                    continue  # what waits is read before anything is given up
                self._go_on(time.monotonic_ns())
        except DeviceError as error:
            self.trouble = self.trouble or str(error)
        except BaseException as error:
            self.trouble = self.trouble or (
                f"{self.name}: the reader has ended: {type(error).__name__}: {error}"
            )

    def _go_on(self, now: int) -> None:
        """Give up a request that has no reply, or make the next one that is due."""
        if self._pending or self._syncing:
            if now - self._asked < GIVE_UP:
                return
            self.counts.lost += self._pending
            self._drop()
            # The late reply of the lost request would look like that of the next one.
            self._syncing, self._asked = min(SYNCS, key=self._syncs.__getitem__), now
            self._syncs[self._syncing] += 1
            send(self._bus, self._frames.identifier(self._syncing))
            return
        if now < self._due:
            return
        if self._whole is not None:
            self.samples.append(self._whole)
            self._whole = None
        # Requests that could not be made are not made up for.
        self._due += self._period
        if now - self._due > self._period:
            self._due = now
        self.counts.requests += 1
        self._asked = time.monotonic_ns()
        self._pending = True
        send(self._bus, self._frames.identifier(SAMPLE[0]))

    def _take(self, frame: can.Message, now: int) -> None:
        if not self._frames.ours(frame.arbitration_id):
            self.counts.others += 1
            return
        wanted = SAMPLE[0] if self._first is None else SAMPLE[1]
        if self._pending and self._fits(frame, wanted):
            if self._first is None:
                self._first, self._answered = bytes(frame.data), now
                return
            gauges = self._frames.gauges(self._first, bytes(frame.data))
            round_trip = self._answered - self._asked
            if round_trip > self.slowest:
                self.counts.slow += 1
            else:
                # It counts once the next request goes out and no third frame came: one of the two
                # may have been somebody else's.
                self._whole = Reading(self.counts.requests, self._asked, self._answered, gauges)
                total, n = self.round_trips
                self.round_trips = (total + round_trip, n + 1)
            self.counts.replies += 1
            self._pending, self._first = False, None
            self._listen(now)
            return
        if self._pending and self._first is None and self._fits(frame, SAMPLE[1]):
            # The first frame was lost, or this one is foreign: then the sensor's own come now,
            # unasked, and tell.
            self.counts.lost += 1
            self._pending = False
            self._listen(now)
            return
        answered = next((q for q, n in self._syncs.items() if n and self._fits(frame, q)), "")
        if answered:
            self._syncs[answered] -= 1
            if answered == self._syncing:
                self._syncing = ""
            return
        if self._syncing and any(self._fits(frame, name) for name in SAMPLE):
            self.counts.late += 1
            return
        self.counts.foreign += 1
        self._whole = None
        self._drop()
        self.trouble = (
            f"{self.name}: a frame that is no reply came on identifier "
            f"0x{frame.arbitration_id:X}, the sensor's; another sender has the same identifier: "
            "change its or device.settings.base_id"
        )

    def _listen(self, now: int) -> None:
        """No request before a frame too many had time to come, also where one is overdue."""
        self._due = max(self._due, now + self._period // QUIET)

    def _drop(self) -> None:
        self._pending, self._first = False, None

    def _fits(self, frame: can.Message, name: str) -> bool:
        return (
            frame.arbitration_id == self._frames.identifier(name)
            and not frame.is_extended_id
            and not frame.is_remote_frame
            and not frame.is_fd
            and len(frame.data) == self._frames.length(name)
        )

    def _receive(self, seconds: float) -> can.Message | None:
        try:
            frame = self._bus.recv(seconds)
        except ValueError:
            # A line of the adapter that was damaged on its way.
            self.counts.corrupt += 1
            return None
        except Exception as error:
            # python-can lets through what the system, the port or a broken line gives.
            raise DeviceError(f"{self.name}: the bus is gone: {error}") from error
        # Its identifier says what is wrong, and may be that of a reply.
        if frame is not None and frame.is_error_frame:
            raise DeviceError(
                f"{self.name}: the CAN controller reports an error (bus off, or nobody "
                "acknowledges); check bit rate, termination and cable"
            )
        return frame

    def _silent(self, message: str) -> str:
        identifier = self._frames.identifier(message)
        if self.counts.others:
            return (
                f"{self.name}: {self.counts.others} frames of other senders came, none is the "
                f"sensor's answer on 0x{identifier:X}; is device.settings.base_id the sensor's?"
            )
        return (
            f"{self.name}: the bus is silent, nothing answers on 0x{identifier:X}; is the sensor "
            "powered, the bus terminated, and device.settings.bitrate the sensor's?"
        )
