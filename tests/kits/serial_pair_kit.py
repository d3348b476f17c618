"""SAMII with joints 2 and 3 driven behind one node on a desk, with the gate over both outputs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from serial_desk_kit import Desk

from samii_rig.devices.protocols import CommandBlock
from samii_rig.errors import GateError
from samii_rig.rig.load import load_rig
from samii_rig.rig.schema import Device, Rig
from samii_rig.run.outputs import at_rest, plan_limits
from samii_rig.run.plan import Plan
from samii_rig.safety.gate import Gate
from samii_rig.safety.judgement import State
from samii_rig.types import SampleBlock
from sim.settings import SimSettings
from sim.wire.node import Node
from sim.wire.plant import Plant, board
from sim.wire.protocol import NodeConfig, OutputConfig

PLAIN = load_rig("samii_two_joints")[0]
BOARD = board(PLAIN)
RIG: Rig = PLAIN.model_copy(
    update={"device": Device(driver="serial_node", settings=BOARD.settings("desk"))}
)
NAMES = tuple(a.name for a in RIG.actuator)
PERIOD, BOOT = 2_000_000, 9  # ns
NULLS = tuple(o.null for o in BOARD.output.values())
CONFIG = NodeConfig(
    PERIOD,
    50,
    2,
    3,
    null=NULLS[0],
    max_jump=1304,
    beside=(OutputConfig(null=NULLS[1], max_jump=1304),),
)
PATIENCE = 25  # samples in the deadman's 50 ms
AHEAD, TICK = 24, 4  # samples: of a reference, and between two looks
LOOPS = tuple(
    one.device_loop()
    for one in plan_limits(
        Plan("kit", RIG.rate_hz, "v_2", 4.0, "theta_2", (), 0, (at_rest(RIG, "v_3"),)), RIG
    )
)


class Joints(Desk):
    """The desk with the rig itself behind it. volts : of the references that `drive` sends."""

    def __init__(self, patch: Callable[[str, object], None], boot: int = BOOT) -> None:
        plant = Plant(PLAIN, BOARD, SimSettings(seed=3))
        super().__init__(RIG, Node(CONFIG, boot), patch, plant)
        plan = Plan("kit", RIG.rate_hz, "v_2", 4.0, "theta_2", (), 0, (at_rest(RIG, "v_3"),))
        channels = self.device.sensor.channels
        self.gate = Gate(self.device.actuator, plan_limits(plan, RIG), channels, lambda _: None)
        self.volts, self.next = (0.3, -0.2), -1
        self.out: list[tuple[int, ...]] = []
        self.blocks: list[SampleBlock] = []

    @property
    def now(self) -> int:
        """ns: the host's clock is the node's here."""
        return self.node.sample * PERIOD

    def look(self, n: int = TICK) -> None:
        """n samples, and the gate sees them; GateError or DeviceError if it ends the run."""
        self.out += self.run(n)
        self.blocks.append(self.device.sensor.read())
        self.gate.observe(self.blocks[-1], self.now)

    def running(self) -> Joints:
        self.look(12)
        self.gate.arm(self.now)
        self.look()
        self.gate.start(self.now)
        return self

    def drive(self, ticks: int) -> None:
        """References of both outputs, rising, sent on in time."""
        for _ in range(ticks):
            first = self.node.sample + 6 if self.next < 0 else self.next
            n = self.node.sample + AHEAD + TICK - first
            rise = np.minimum(np.arange(first, first + n) / 100.0, 1.0)
            blocks = tuple(CommandBlock(first, v * rise, np.zeros(n)) for v in self.volts)
            self.gate.write(blocks, self.now)
            self.next = first + n
            self.look()

    def live(self) -> Joints:
        self.running().drive(12)
        assert all(self.out[-1])
        return self

    def ended(self, within: int) -> int:
        """Both outputs are at null within so many samples, and stay there; after how many."""
        out = self.run(within + 60)
        after = next(i for i, v in enumerate(out) if not any(v))
        assert after <= within
        assert not any(any(v) for v in out[after:])
        return after

    def refused(self, what: Callable[[], None]) -> str:
        """The gate ends it, at null and in FAULT; what it says."""
        try:
            what()
        except GateError as error:
            assert self.gate.state is State.FAULT
            return str(error)
        raise AssertionError("it goes on")
