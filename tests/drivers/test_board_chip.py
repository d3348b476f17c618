"""The firmware on its chip, register by register: every path of the output ends at null.

The chip is a model (chip_kit.py); what it cannot show is on docs/evidence/board.md.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from chip_kit import (
    ADC_SELECT,
    BSRR,
    DAC_1_SELECT,
    DAC_RESET,
    DAC_SELECT,
    GPIOA,
    GPIOB,
    GPIOC,
    IWDG_KR,
    IWDG_PR,
    IWDG_RLR,
    SECTOR_BYTES,
    SUPPLY,
    TIM2_CNT,
    TIM3_CNT,
    TIM5_CNT,
    Chip,
    Dac,
    library,
)

from drivers.serial_node.wire import (
    Answer,
    Code,
    Decoder,
    Event,
    Hello,
    Samples,
    Type,
    configure_body,
    frame,
    stream_body,
)

NULL = 37  # counts
PER_VOLT = 3276.8
AT_NULL = pytest.approx(NULL / PER_VOLT)
DEADMAN_MS, PERIOD_MS = 50, 2
OUT = 16384  # counts: 5 V
LSI_FASTEST = 47_000  # Hz, of the data sheet, as 17_000 is the slowest
LOOP = {
    "encoder": 0,
    "adc_mask": 1,
    "kp_q16": 0,
    "max_output": 20000,
    "max_step": 32767,
    "max_angle": 30000,
    "max_jump": 1000,
    "centre": 0,
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return library(tmp_path_factory.mktemp("chip"), NULL_COUNTS=NULL)


Make = Callable[..., Chip]


@pytest.fixture
def boots(made: Path, tmp_path: Path) -> Make:
    """A chip that comes out of reset; every one has memory of its own."""
    n = iter(range(100))

    def boot(flash: bytearray | None = None, **given: bool) -> Chip:
        own = tmp_path / f"{next(n)}.so"
        shutil.copy(made, own)
        return Chip(own, flash, **given)

    return boot


class Live:
    """A chip whose output is live at 5 V."""

    def __init__(self, chip: Chip) -> None:
        self.chip, self.decoder, self.seq = chip, Decoder(), 0
        self.got: list[object] = []
        self.run()
        self.ask(Type.CONFIGURE, configure_body(**LOOP))
        self.run()
        assert [m.code for m in self.got if isinstance(m, Answer)] == [Code.OK]
        self.stream()
        self.run(3)
        assert chip.dac.volts == pytest.approx((OUT + NULL) / PER_VOLT)
        assert chip.pins[SUPPLY] == 1

    def ask(self, kind: Type, body: bytes = b"") -> None:
        self.seq += 1
        hello = next(m for m in self.got if isinstance(m, Hello))
        self.chip.receive(frame(kind, hello.boot, self.seq, body))

    def stream(self, n: int = 60) -> None:
        first = self.chip.register[TIM5_CNT] // 2000
        self.ask(Type.STREAM, stream_body(first, [OUT] * n, [0] * n))

    def run(self, n: int = 1) -> None:
        for _ in range(n):
            self.chip.tick()
            self.chip.register[TIM5_CNT] += 2000
        self.got += self.decoder.feed(bytes(self.chip.sent))
        self.chip.sent.clear()

    def until_null(self) -> int:
        """Samples until the output is at null and the supply off."""
        for n in range(1, 100):
            self.run()
            if self.chip.dac.volts == AT_NULL:
                assert self.chip.pins[SUPPLY] == 0
                return n
        raise AssertionError("it stays live")

    @property
    def reasons(self) -> list[int]:
        return [m.reason for m in self.got if isinstance(m, Event)]


@pytest.fixture
def live(boots: Make) -> Live:
    return Live(boots())


def supply_after_converter(chip: Chip) -> bool:
    """Whether the last time that the supply line was set, the converter had its counts before."""
    supply = max(i for i, w in enumerate(chip.writes) if w[0] == GPIOC + BSRR)
    converter = max(i for i, w in enumerate(chip.writes) if w == (GPIOB + BSRR, 1 << DAC_SELECT))
    return converter < supply


# What it does from its reset on


def test_from_reset_to_the_first_sample_the_output_is_at_null_and_the_supply_off(boots):
    chip = boots()
    assert chip.dac.volts == AT_NULL
    assert chip.pins[SUPPLY] == 0
    assert not any(w == (GPIOC + BSRR, 1 << SUPPLY) for w in chip.writes)
    first = [w for w in chip.writes if w[0] in (GPIOB + BSRR, GPIOC + BSRR)][:2]
    assert first == [(GPIOC + BSRR, 1 << SUPPLY + 16), (GPIOB + BSRR, 1 << DAC_RESET + 16)]
    chip.tick(5)
    assert (chip.dac.volts, chip.pins[SUPPLY]) == (AT_NULL, 0)


@pytest.mark.parametrize("missing", ["crystal", "converter"])
def test_what_does_not_start_leaves_ground_and_a_watchdog_that_tries_again(
    boots, missing, monkeypatch
):
    if missing == "converter":
        monkeypatch.setattr("chip_kit.Dac.shift", lambda self, data: None)
    chip = boots(crystal=missing != "crystal")
    assert (chip.dac.volts, chip.pins[SUPPLY], chip.pins[DAC_RESET]) == (0.0, 0, 0)
    assert (IWDG_KR, 0xCCCC) in chip.writes
    assert chip.feeds == 1
    assert not chip.sent


def test_its_clocks_are_those_that_the_numbers_assume(boots):
    r = boots().register
    pll = r[0x4002_3804]
    m, n, p = pll & 63, pll >> 6 & 511, 2 * (pll >> 16 & 3) + 2
    assert pll >> 22 & 1, "from the crystal"
    assert 8e6 / m == 2e6
    assert 8e6 / m * n / p == 168e6
    assert r[0x4002_3C00] & 7 == 5, "flash wait states at 168 MHz"
    assert r[0x4002_3808] >> 10 & 7 == 5, "APB1 at 42 MHz"
    assert (r[0x4000_0828] + 1) * (r[0x4000_082C] + 1) == 84e6 / 500
    assert 42e6 / r[0x4000_4408] == pytest.approx(921600, rel=0.01)
    assert 42e6 / (2 << (r[0x4000_3800] >> 3 & 7)) < 17e6, "the ADC's fastest clock"
    assert r[0x4002_3800] & 1 << 19, "a crystal that stops is an NMI"
    assert r[0x4000_7000] >> 4 & 15 == 5 << 1 | 1, "below 2.7 V is an interrupt"
    assert r[0x4000_7000] >> 14 & 1, "the core's voltage that 168 MHz need"
    assert pll >> 28 == 2, "reserved bits stay"


def test_its_pins_are_those_of_the_wiring_table(boots):
    chip = boots()
    for port, pins, mode in (
        (GPIOA, (2, 3, 15), 2),
        (GPIOB, (3, 13, 14, 15), 2),
        (GPIOC, (6, 7), 2),
        (GPIOB, (DAC_SELECT, DAC_RESET, ADC_SELECT), 1),
        (GPIOC, (SUPPLY,), 1),
        (GPIOC, (5,), 0),
    ):
        assert {chip.mode(port, p) for p in pins} == {mode}
    docs = Path(__file__).resolve().parents[2] / "docs"
    page = (docs / "reference" / "serial-board.md").read_text()
    assert chip.mode(GPIOB, DAC_1_SELECT) == 0, "left alone by a board with one output"
    for name in ("PA2", "PA3", "PA15", "PB0", "PB1", "PB3", "PB5", "PB12", "PB13", "PB14", "PB15"):
        assert f"| {name} |" in page
    for name in ("PC4", "PC5", "PC6", "PC7"):
        assert f"| {name} |" in page


def test_every_boot_has_another_number_until_the_sector_is_full_and_begins_again(boots):
    flash = bytearray(b"\xff" * SECTOR_BYTES)

    def number() -> int:
        live = Live(boots(flash))
        return next(m.boot for m in live.got if isinstance(m, Hello))

    assert [number() for _ in range(3)] == [1, 2, 3]
    flash[: 2 * 65534] = bytes(2 * 65534)
    assert [number() for _ in range(3)] == [65535, 1, 2]


def test_the_watchdog_resets_within_the_deadman_and_leaves_two_samples(boots):
    r = boots().register
    assert r[IWDG_PR] == 0
    assert r[IWDG_RLR] * 4 / 17_000 <= DEADMAN_MS / 1e3
    assert r[IWDG_RLR] * 4 / LSI_FASTEST > 2 * PERIOD_MS / 1e3


# What a sample does


def test_the_supply_is_switched_after_the_converter_and_the_watchdog_is_fed_last(live):
    assert supply_after_converter(live.chip)
    before = live.chip.feeds
    live.chip.tick()
    assert live.chip.feeds == before + 1
    tick = live.chip.writes[-60:]
    assert (IWDG_KR, 0xAAAA) in tick
    after = tick[tick.index((IWDG_KR, 0xAAAA)) + 1 :]
    assert all(w[0] in (0x4000_4404, 0x4000_440C) for w in after), "only the port, by its interrupt"
    live.ask(Type.ZERO)
    assert live.until_null() <= 2
    assert supply_after_converter(live.chip)


def test_inputs_are_read_as_the_converter_and_the_counters_have_them(live):
    chip = live.chip
    chip.adc.counts = [0, -1, 1, -32768, 32767, 1234, -1234, 7]
    chip.register[TIM2_CNT] = 2**32 - 5
    for count in (0, 30_000, 60_000, 10_000, 50_000, 20_000):
        chip.register[TIM3_CNT] = count
        live.run()
    live.run(4)
    data = next(m.data for m in reversed(live.got) if isinstance(m, Samples))
    row = data[-(9 + 2 * 4 + 2 * 8) :]
    encoders = [int.from_bytes(row[9 + 4 * i : 13 + 4 * i], "little", signed=True) for i in (0, 1)]
    adcs = [int.from_bytes(row[17 + 2 * i : 19 + 2 * i], "little", signed=True) for i in range(8)]
    assert encoders == [-5, 30_000 + 30_000 + 15_536 - 25_536 - 30_000]
    assert adcs == chip.adc.counts


# Ways to null


def test_no_stream_ends_at_null_at_the_deadman(live):
    live.run(20)
    assert live.chip.dac.volts > 4.0
    assert 20 + 3 + live.until_null() == DEADMAN_MS // PERIOD_MS + 1
    assert 3 in live.reasons


@pytest.mark.parametrize(("what", "reason"), [("emergency", 7), ("adc", 6), ("jump", 5)])
def test_an_input_ends_at_null_in_its_sample(live, what, reason):
    chip = live.chip
    if what == "emergency":
        chip.emergency = True
    elif what == "adc":
        chip.adc.there = False  # its bus is pulled up: the end of its range
    else:
        chip.register[TIM2_CNT] = 1001
    assert live.until_null() == 1
    live.run(4)
    assert live.reasons[-1] == reason


@pytest.mark.parametrize("bus", [True, False])
def test_a_fault_puts_null_out_then_the_supply_off_and_feeds_nothing(live, bus):
    chip = live.chip
    chip.spi, before = bus, chip.feeds
    chip.frame = b"\x30"  # in the midst of a frame
    chip.wrong()
    # A converter that takes nothing is held in reset: ground.
    assert chip.dac.volts == (AT_NULL if bus else 0.0)
    assert chip.pins[SUPPLY] == 0
    assert supply_after_converter(chip)
    assert chip.feeds == before


def test_a_converter_that_holds_something_else_ends_within_three_samples(live):
    live.chip.dac.stuck = True
    live.ask(Type.ZERO)
    live.run(2)
    before = live.chip.feeds
    live.run(3)
    assert live.chip.dac.volts == 0.0
    assert live.chip.pins[SUPPLY] == 0
    assert live.chip.feeds <= before + 1


def test_a_reset_clamps_the_output_and_the_next_boot_is_at_null(live, boots):
    flash = live.chip.flash
    live.chip.dac.reset()  # its pin is pulled down while the chip's floats
    assert live.chip.dac.volts == 0.0
    again = boots(flash)
    assert (again.dac.volts, again.pins[SUPPLY]) == (AT_NULL, 0)
    old = frame(Type.STREAM, 1, 50, stream_body(0, [OUT] * 60, [0] * 60))
    again.receive(old)
    again.tick(60)
    assert (again.dac.volts, again.pins[SUPPLY]) == (AT_NULL, 0)


# Two outputs: what ends one ends both


NULL_1 = -12  # counts, of the second output
BOTH = [DAC_SELECT, DAC_1_SELECT]
AT_NULLS = [AT_NULL, pytest.approx(NULL_1 / PER_VOLT)]


@pytest.fixture(scope="module")
def made_two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two")
    return library(folder, NULL_COUNTS=NULL, OUTPUTS=2, NULL_COUNTS_1=NULL_1, MAX_OUTPUT_1=10000)


@pytest.fixture
def pair(made_two: Path, tmp_path: Path) -> Pair:
    own = tmp_path / "two.so"
    shutil.copy(made_two, own)
    return Pair(Chip(own))


class Pair:
    """A chip with two outputs, live at 2 V and at -1 V."""

    def __init__(self, chip: Chip) -> None:
        self.chip, self.decoder, self.seq = chip, Decoder(), 0
        self.got: list[object] = []
        assert self.volts == AT_NULLS
        assert chip.pins[SUPPLY] == 0
        self.run()
        second = {**LOOP, "encoder": 1, "max_output": 10000, "adc_mask": 0}
        self.ask(Type.CONFIGURE, configure_body(**LOOP) + configure_body(**second))
        self.run()
        assert [m.code for m in self.got if isinstance(m, Answer)] == [Code.OK]
        first = chip.register[TIM5_CNT] // 2000
        pairs = [6554, -3277] * 30
        for part in (0, 30):
            self.ask(Type.STREAM, stream_body(first + part, pairs, [0] * 60, 2))
        self.run(3)
        assert self.volts == [
            pytest.approx((6554 + NULL) / PER_VOLT),
            pytest.approx((NULL_1 - 3277) / PER_VOLT),
        ]
        assert chip.pins[SUPPLY] == 1

    def ask(self, kind: Type, body: bytes = b"") -> None:
        self.seq += 1
        hello = next(m for m in self.got if isinstance(m, Hello))
        self.chip.receive(frame(kind, hello.boot, self.seq, body, hello.version))

    def run(self, n: int = 1) -> None:
        for _ in range(n):
            self.chip.tick()
            self.chip.register[TIM5_CNT] += 2000
        self.got += self.decoder.feed(bytes(self.chip.sent))
        self.chip.sent.clear()

    @property
    def volts(self) -> list[float]:
        return [dac.volts for dac in self.chip.dacs.values()]


def test_two_outputs_are_at_null_from_reset_on_and_say_what_they_are(pair):
    hello = next(m for m in pair.got if isinstance(m, Hello))
    assert [(o.null, o.max_output) for o in hello.outputs] == [(NULL, 32767), (NULL_1, 10000)]
    assert {pair.chip.mode(GPIOB, pin) for pin in BOTH} == {1}


def test_no_stream_ends_both_at_null_in_one_sample(pair):
    n = 0
    while pair.volts != AT_NULLS:
        assert not any(v == null for v, null in zip(pair.volts, AT_NULLS, strict=True))
        pair.run()
        n += 1
    assert 3 + n == DEADMAN_MS // PERIOD_MS + 1
    assert pair.chip.pins[SUPPLY] == 0


@pytest.mark.parametrize("counter", [TIM2_CNT, TIM3_CNT])
def test_a_jump_of_either_encoder_ends_both_in_its_sample(pair, counter):
    pair.chip.register[counter] = 1001
    pair.run()
    assert pair.volts == AT_NULLS
    assert pair.chip.pins[SUPPLY] == 0


@pytest.mark.parametrize("stuck", BOTH)
def test_either_converter_that_holds_something_else_ends_both_within_three_samples(pair, stuck):
    pair.chip.dacs[stuck].stuck = True
    pair.ask(Type.ZERO)
    pair.run(2)
    before = pair.chip.feeds
    pair.run(3)
    assert pair.volts == [0.0, 0.0]
    assert pair.chip.pins[SUPPLY] == 0
    assert pair.chip.feeds <= before + 1


@pytest.mark.parametrize("bus", [True, False])
def test_a_fault_puts_both_nulls_out_before_the_supply_goes(pair, bus):
    pair.chip.spi = bus
    pair.chip.frame = b"\x30"
    pair.chip.wrong()
    assert pair.volts == (AT_NULLS if bus else [0.0, 0.0])
    assert pair.chip.pins[SUPPLY] == 0
    writes = pair.chip.writes
    supply = max(i for i, w in enumerate(writes) if w[0] == GPIOC + BSRR)
    for pin in BOTH:
        assert max(i for i, w in enumerate(writes) if w == (GPIOB + BSRR, 1 << pin)) < supply


@pytest.mark.parametrize("missing", BOTH)
def test_either_converter_that_does_not_start_leaves_both_at_ground(
    made_two, tmp_path, missing, monkeypatch
):
    own, shift = tmp_path / "two.so", Dac.shift
    shutil.copy(made_two, own)
    built: list[Dac] = []
    monkeypatch.setattr(
        Dac, "shift", lambda d, data: None if d is built[BOTH.index(missing)] else shift(d, data)
    )
    init = Dac.__init__
    monkeypatch.setattr(Dac, "__init__", lambda d: (built.append(d), init(d))[1])
    chip = Chip(own)
    assert [d.volts for d in chip.dacs.values()] == [0.0, 0.0]
    assert (chip.pins[SUPPLY], chip.pins[DAC_RESET]) == (0, 0)
    assert not chip.sent
