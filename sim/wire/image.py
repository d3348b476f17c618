"""The firmware's image in an emulator, in place of the simulated node.

Every sample is held against the simulated node: the same bytes and inputs in, the same counts and
bytes out.
"""

from __future__ import annotations

from samii_rig.errors import DeviceError
from sim.wire.emulator import READ_AT_ONCE, SILENT, WITHIN, Emulator
from sim.wire.node import Node
from sim.wire.protocol import NodeConfig


class ImageNode(Node):
    """The image with the simulated node's interface, and held against it at every sample.

    DeviceError if they differ, or if the image says nothing by itself.
    """

    def __init__(self, emulator: Emulator, config: NodeConfig, boot: int, sample: int = 0) -> None:
        self._emulator = emulator
        if emulator.booted:
            emulator.sample(0, (), (), False, "reset")
        self._begin(config, boot, sample, boot)

    def _begin(self, config: NodeConfig, boot: int, sample: int, told: int) -> None:
        super().__init__(config, boot, sample)
        self._wrong = ""  # what the image is told to do at the next sample
        self._ended, self._silent = False, 0  # it runs no samples any more, for so many
        nulls = tuple(o.null for o in config.outputs)
        self._held, self._on = nulls, False
        self._out = bytearray()
        self._emulator.boot(config, told, sample)
        said = self._emulator.outputs(WITHIN)
        if said is None or said != (0, 0, nulls, boot, 0, 0):
            raise DeviceError(f"the image does not start at null: {said}")

    def wrong(self, what: str) -> None:
        """At the next sample the image does what WRONG has."""
        self._wrong = what

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        if not self._ended:
            super().receive(data)
            self._emulator.send(data)

    def transmit(self, room: int = READ_AT_ONCE) -> bytes:
        """At most `room` bytes to the host."""
        out = bytes(self._out[:room])
        del self._out[:room]
        return out

    @property
    def supply(self) -> bool:
        """Whether the supply line is on."""
        return self._on

    def take(
        self, clock_us: int, encoders: tuple[int, ...], adcs: tuple[int, ...], emergency: bool
    ) -> tuple[int, ...]:
        """One sample; the counts to put out of each output."""
        if self._ended:
            return self._no_sample()
        wrong, self._wrong = self._wrong, ""
        self._emulator.sample(clock_us, encoders, adcs, emergency, wrong)
        said = self._emulator.outputs(SILENT if wrong == "hang" else WITHIN)
        if said is not None:
            self._held, self._on = said.counts, bool(said.supply)
        if wrong:
            if said is not None and not said.handler:
                raise DeviceError(f"the image went on after {wrong}")
            self._ended = True
            return self._no_sample()
        if said is None:
            raise DeviceError(
                f"the image says nothing at sample {self.sample}{self._emulator.ended}"
            )
        data = self._emulator.receive(said.went)
        mine = said.counts, said.boot, self._on, data
        expected = super().take(clock_us, encoders, adcs, emergency)
        theirs = expected, self.boot, self.live, super().transmit()
        if mine != theirs:
            raise DeviceError(
                f"the image is not the simulated node at sample {self.sample - 1}: counts, boot, "
                f"supply, bytes {mine}; expected {theirs}"
            )
        self._out += data
        return self._held

    def _no_sample(self) -> tuple[int, ...]:
        """The converters hold what they held, until the watchdog resets the chip."""
        self._silent += 1
        dog = self._emulator.watchdog
        if dog.started and self._silent * self.config.period_ns * 1e-9 >= dog.seconds:
            self._emulator.reset()
            self._begin(self.config, self.boot % 0xFFFF + 1, 0, 0)
        return self._held
