"""The port of a serial I/O node: for one program alone, read by a thread, written on demand."""

from __future__ import annotations

import math
import threading
import time
from collections import deque

import serial

from drivers.ports import open_port
from drivers.serial_node.wire import (
    WORD,
    Answer,
    Code,
    Decoder,
    Event,
    Hello,
    OtherVersion,
    Reboot,
    Samples,
    Type,
    frame,
    reason_text,
)
from samii_rig.errors import DeviceError

HELLO_WITHIN = 3.0  # s; a board that resets when its port opens needs two to boot
ASK_EVERY = 0.25  # s
ANSWER_WITHIN = 0.25  # s
TRIES = 3  # of a request whose answer did not come
ROUND_TRIPS = 4  # of which the shortest says how long a frame is on its way at most
FRAMES_KEPT = 8192  # SAMPLES frames that wait for read(); over a minute, what is older is lost


class Link:
    """One open port. Only `send` and `request` transmit, and nothing here calls them.

    samples : frames that arrived and nobody took yet, each with the host's monotonic time of its
        arrival, ns. events : the node's, newest last.
    trouble : why nothing more will come, "" while all is well.
    round_trip : s, the shortest from a question to its answer, inf before any.
    """

    def __init__(self, port: str, baud: int) -> None:
        self.name = port
        self.decoder = Decoder()
        self.samples: deque[tuple[int, Samples]] = deque(maxlen=FRAMES_KEPT)
        self.events: deque[Event] = deque(maxlen=FRAMES_KEPT)
        self._last: Event | None = None
        self.trouble = ""
        self.refused = 0
        self.round_trip = math.inf
        self._port = open_port(port, baud)
        self._seq = 0
        self._hello: Hello | None = None
        self._other: OtherVersion | None = None
        self._answers: dict[int, Answer] = {}
        self._news = threading.Condition()
        self._writing = threading.Lock()
        self._ending = threading.Event()
        self._reader = threading.Thread(target=self._read, name=f"reader of {port}", daemon=True)
        self._reader.start()

    def identify(self, baud: int) -> Hello:
        """Ask who is there; DeviceError in one line if that is no node of this version."""
        until = time.monotonic() + HELLO_WITHIN
        while time.monotonic() < until:
            self._transmit(frame(Type.IDENTIFY, 0, 0))
            with self._news:
                self._news.wait_for(self._known, ASK_EVERY)
                if self._hello is not None:
                    # The node takes only what is newer than the last host's last frame.
                    self._seq = self._hello.host_seq
                    return self._hello
                if self._other is not None:
                    raise DeviceError(
                        f"{self.name}: the node speaks protocol version {self._other.version}, "
                        "this driver versions 1 and 2; install the firmware that belongs to it"
                    )
                if self.trouble:
                    raise DeviceError(self.trouble)
        if self.decoder.received:
            raise DeviceError(
                f"{self.name}: {self.decoder.received} bytes came and no frame of a node among "
                f"them; is device.settings.baud = {baud} the node's, and is it a node?"
            )
        raise DeviceError(
            f"{self.name}: nothing answers in {HELLO_WITHIN:g} s; is the node powered, is it this "
            "port, and does it run its firmware?"
        )

    def measure(self, baud: int) -> None:
        """Ask some more and note the shortest time to the answer."""
        for _ in range(ROUND_TRIPS):
            with self._news:
                self._hello = None
            asked = time.monotonic()
            self.identify(baud)
            self.round_trip = min(self.round_trip, time.monotonic() - asked)

    def send(self, kind: Type, body: bytes = b"") -> int:
        """Transmit one frame; its number. DeviceError if the port does not take it."""
        assert self._hello is not None
        with self._writing:
            self._seq = (self._seq + 1) % WORD
            hello = self._hello
            self._put(frame(kind, hello.boot, self._seq, body, hello.version))
            return self._seq

    def request(self, kind: Type, body: bytes = b"") -> Code:
        """Transmit and wait for what became of it; DeviceError if no answer comes."""
        self._answers.clear()
        for _ in range(TRIES):
            seq = self.send(kind, body)
            with self._news:
                self._news.wait_for(lambda s=seq: s in self._answers or self.trouble, ANSWER_WITHIN)  # type: ignore[misc]
                if seq in self._answers:
                    return Code(self._answers.pop(seq).code)
                if self.trouble:
                    raise DeviceError(self.trouble)
        raise DeviceError(f"{self.name}: the node does not answer to {kind.name}")

    def close(self) -> None:
        """Stop reading and give the port back; may be called twice."""
        self._ending.set()
        self._reader.join()
        self._port.close()

    def _known(self) -> bool:
        return bool(self._hello or self._other or self.trouble)

    def _transmit(self, data: bytes) -> None:
        with self._writing:
            self._put(data)

    def _put(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (OSError, serial.SerialException) as error:
            raise DeviceError(f"{self.name}: the port takes nothing: {error}") from error

    def _read(self) -> None:
        """The reader: whatever ends it is trouble, and so never only silence."""
        try:
            while not self._ending.is_set():
                data = self._port.read(max(1, self._port.in_waiting))
                for message in self.decoder.feed(data):
                    self._take(message)
        except Exception as error:
            self._fail(f"{self.name}: the port is gone: {error}")

    def _fail(self, trouble: str) -> None:
        with self._news:
            self.trouble = self.trouble or trouble
            self._news.notify_all()

    def _take(self, message: object) -> None:
        match message:
            case Samples():
                self.samples.append((time.monotonic_ns(), message))
            case Event():
                self.events.append(message)
                self._last = message
            case Answer(type=Type.STREAM):
                self.refused += 1
            case OtherVersion() if self._hello is not None:
                self._fail(
                    f"{self.name}: the node speaks protocol version {message.version} now; its "
                    "firmware was changed; start a new run"
                )
            case Reboot():
                self._fail(
                    f"{self.name}: the node has rebooted (boot {message.boot}); its output is at "
                    "null; find out why, then start a new run"
                )
            case _:
                with self._news:
                    if isinstance(message, Hello):
                        self._hello = message
                    elif isinstance(message, OtherVersion):
                        self._other = message
                    elif isinstance(message, Answer):
                        self._answers[message.seq] = message
                    self._news.notify_all()

    def last_reason(self) -> str:
        """Why the node's state changed last, in words; "" if it did not."""
        return reason_text(self._last.reason) if self._last else ""
