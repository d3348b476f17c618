"""The chip that the firmware is flashed to, register by register, with its converters.

`board_stm32f405.c`, `main.c`, `wire.c` and `ticks.c` are compiled for this machine; what they read
and write of the chip's registers ends here. The model is written from the chip's manual and the
data sheets of the converters, not from the firmware.
"""

from __future__ import annotations

import ctypes
import subprocess
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import pytest
from board_kit import BOARD
from node_kit import compiler

SHIM = """
#include <setjmp.h>
#include "port.h"
#include "stm32f405.h"
int node_main(void);
void tim4_handler(void);
uint32_t (*get)(uint32_t);
void (*set)(uint32_t, uint32_t);
static jmp_buf back;
uint32_t reg_get(uint32_t address) { return get(address); }
void reg_set(uint32_t address, uint32_t value) { set(address, value); }
void reg_set16(uint32_t address, uint16_t value) { set(address, value); }
void wait_for_interrupt(void) { longjmp(back, 1); }
void boot(void) { if (!setjmp(back)) node_main(); }
void tick(void) { if (!setjmp(back)) tim4_handler(); }
void wrong(void) { if (!setjmp(back)) fault_handler(); }
"""
SOURCES = ("main.c", "wire.c", "ticks.c", "board_stm32f405.c")
CORE = ("node.c", "frame.c", "receive.c", "send.c")

RCC_CR, RCC_CFGR, PWR_CR = 0x4002_3800, 0x4002_3808, 0x4000_7000
HSE, CSS, PLL = 1 << 16, 1 << 19, 1 << 24
FLASH_KEYR, FLASH_CR = 0x4002_3C04, 0x4002_3C10
GPIOA, GPIOB, GPIOC = 0x4002_0000, 0x4002_0400, 0x4002_0800
MODER, IDR, BSRR = 0x00, 0x10, 0x18
SPI_CR1, SPI_SR, SPI_DR = 0x4000_3800, 0x4000_3808, 0x4000_380C
USART_SR, USART_DR = 0x4000_4400, 0x4000_4404
IWDG_KR, IWDG_PR, IWDG_RLR, IWDG_SR = 0x4000_3000, 0x4000_3004, 0x4000_3008, 0x4000_300C
TIM2_CNT, TIM3_CNT, TIM5_CNT = 0x4000_0024, 0x4000_0424, 0x4000_0C24
SECTOR, SECTOR_BYTES = 0x0806_0000, 1 << 17
# What is not zero after a reset and is changed bit by bit.
RESET = {RCC_CR: 0x83, 0x4002_3804: 0x2400_3010, PWR_CR: 1 << 14}
RESET |= {GPIOA: 0xA800_0000, GPIOB: 0x280, GPIOA + 0xC: 0x6400_0000, GPIOB + 0xC: 0x100}
SUPPLY, EMERGENCY, DAC_RESET, DAC_SELECT, ADC_SELECT = 4, 5, 1, 0, 12
DAC_1_SELECT = 5  # of the second output; on port B, as those before it but SUPPLY and EMERGENCY


def library(folder: Path, **numbers: int) -> Path:
    """The firmware for this machine, with numbers of config.h."""
    command = compiler()
    if command is None:
        pytest.skip("no C compiler: pip install ziglang, or any cc in the PATH")
    shim, made = folder / "shim.c", folder / "chip.so"
    shim.write_text(SHIM)
    sources = [shim, *(BOARD / s for s in SOURCES), *(BOARD.parent / s for s in CORE)]
    given = [f"-D{name}={value}" for name, value in numbers.items()]
    flags = ["-std=gnu99", "-Wall", "-Wextra", "-Werror", "-O1", "-fPIC", "-shared"]
    where = [f"-I{BOARD}", f"-I{BOARD.parent}", "-DNODE_BOARD_TEST", "-Dmain=node_main"]
    done = subprocess.run(
        [*command, *flags, *where, *given, *map(str, sources), "-o", str(made)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return made


class Dac:
    """AD5761R: 24 bits a frame; the output clamped to ground until its control register is set."""

    def __init__(self) -> None:
        self.control: int | None = None
        self.code, self.back, self.stuck = 0x8000, 0, False

    def reset(self) -> None:
        self.control, self.code = None, 0x8000

    def shift(self, frame: bytes) -> None:
        if len(frame) != 3:
            return
        word = int.from_bytes(frame, "big")
        what, value = word >> 16 & 15, word & 0xFFFF
        self.back = self.code if what == 0xB else 0
        if what == 4:
            self.control = value
        elif what == 3 and not self.stuck:
            self.code = value

    def answer(self, n: int) -> int:
        return self.back >> 8 * (2 - n) & 0xFF if n else 0

    @property
    def volts(self) -> float:
        if self.control is None:
            return 0.0
        assert self.control & 7 == 0, "+-10 V"
        assert self.control & 1 << 5, "own reference"
        assert not self.control & 1 << 7, "straight binary"
        assert self.control >> 3 & 3 == 1, "mid scale at its start"
        assert self.control >> 9 & 3 == 1, "mid scale after a clear"
        return (self.code - 0x8000) * 10.0 / 0x8000


class Adc:
    """ADS8688: 32 bits a frame; the last 16 are of the input that the frame before chose."""

    def __init__(self) -> None:
        self.counts = [100 * i for i in range(8)]
        self.chosen, self.there = 0, True

    def shift(self, frame: bytes) -> None:
        if len(frame) == 4 and frame[0] & 0xE3 == 0xC0:
            self.chosen = frame[0] >> 2 & 7

    def answer(self, n: int) -> int:
        if not self.there:
            return 0xFF
        code = self.counts[self.chosen] + 0x8000
        return 0 if n < 2 else code >> 8 * (3 - n) & 0xFF


class Chip:
    """One chip since its reset; `writes` is all that was written, in order."""

    def __init__(self, made: Path, flash: bytearray | None = None, *, crystal: bool = True) -> None:
        self.c = ctypes.CDLL(str(made))
        self.crystal, self.spi = crystal, True
        self.register = defaultdict(int, RESET)
        self.flash = bytearray(b"\xff" * SECTOR_BYTES) if flash is None else flash
        self.keys: list[int] = []
        self.writes: list[tuple[int, int]] = []
        self.dacs, self.adc = {DAC_SELECT: Dac(), DAC_1_SELECT: Dac()}, Adc()
        # In reset all pins float, and resistors pull these down: docs/reference/serial-board.md.
        self.pins = {SUPPLY: 0, DAC_RESET: 0, DAC_SELECT: 1, DAC_1_SELECT: 1, ADC_SELECT: 1}
        self.frame, self.emergency, self.sent = b"", False, bytearray()
        self.arrived = bytearray()
        self.calls: list[Callable[..., object]] = [
            ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_uint32)(self.get),
            ctypes.CFUNCTYPE(None, ctypes.c_uint32, ctypes.c_uint32)(self.set),
        ]
        for name, call in zip(("get", "set"), self.calls, strict=True):
            pointer = ctypes.c_void_p.in_dll(self.c, name)
            pointer.value = ctypes.cast(call, ctypes.c_void_p).value  # type: ignore[arg-type]
        self.c.boot()

    def get(self, address: int) -> int:
        r = self.register
        if SECTOR <= address < SECTOR + SECTOR_BYTES:
            at = address - SECTOR
            return int.from_bytes(self.flash[at : at + 4], "little")
        if address == RCC_CR:
            ready = HSE << 1 if self.crystal and r[address] & HSE else 0
            return r[address] | ready | (PLL << 1 if ready and r[address] & PLL else 0)
        if address == RCC_CFGR:
            return r[address] & ~12 | (r[address] & 3) << 2
        if address == GPIOC + IDR:
            return (1 << EMERGENCY if self.emergency else 0) | 1 << 15
        if address == SPI_SR:
            return 1 if self.spi else 0
        if address == USART_SR:
            return 0xC0 | (1 << 5 if self.arrived else 0)
        if address == USART_DR:
            return self.arrived.pop(0)
        return r[address]

    def set(self, address: int, value: int) -> None:
        self.writes.append((address, value))
        if SECTOR <= address < SECTOR + SECTOR_BYTES:
            assert self.register[FLASH_CR] & 0x301 == 0x101, "16 bits are programmed"
            at = address - SECTOR
            self.flash[at] &= value & 0xFF
            self.flash[at + 1] &= value >> 8
        elif address == FLASH_KEYR:
            self.keys = [*self.keys, value][-2:]
        elif address == FLASH_CR:
            unlocked = self.keys == [0x4567_0123, 0xCDEF_89AB]
            assert unlocked or value == 1 << 31, "the flash is locked"
            if value & 1 << 31:
                self.keys = []
            if value & 0x1_00FA == 1 << 16 | 7 << 3 | 2:
                self.flash[:] = b"\xff" * SECTOR_BYTES
        elif address in (GPIOB + BSRR, GPIOC + BSRR):
            for pin in range(16):
                if value >> pin & 1 or value >> 16 + pin & 1:
                    self._pin(address, pin, value >> pin & 1)
            return
        elif address == SPI_DR:
            chosen = [pin for pin in (ADC_SELECT, *self.dacs) if not self.pins[pin]]
            assert len(chosen) <= 1, "two converters on the bus at once"
            chip = self._selected(*chosen) if chosen else self.dac
            self.register[SPI_DR] = chip.answer(len(self.frame))
            self.frame += bytes([value])
            return
        elif address == USART_DR:
            self.sent.append(value)
        self.register[address] = value

    @property
    def dac(self) -> Dac:
        """The first output's converter."""
        return self.dacs[DAC_SELECT]

    def _selected(self, pin: int) -> Dac | Adc:
        return self.adc if pin == ADC_SELECT else self.dacs[pin]

    def _pin(self, port: int, pin: int, level: int) -> None:
        if port == GPIOC + BSRR:
            if pin == SUPPLY:
                self.pins[pin] = level
            return
        if pin in (ADC_SELECT, *self.dacs):
            if level and not self.pins[pin]:
                self._selected(pin).shift(self.frame)
            self.frame = b""
        self.pins[pin] = level
        if pin == DAC_RESET and not level:
            for dac in self.dacs.values():
                dac.reset()

    def mode(self, port: int, pin: int) -> int:
        """0 an input, 1 an output, 2 a peripheral's."""
        return self.register[port + MODER] >> 2 * pin & 3

    @property
    def feeds(self) -> int:
        return sum(w == (IWDG_KR, 0xAAAA) for w in self.writes)

    def tick(self, n: int = 1) -> None:
        """So many samples."""
        for _ in range(n):
            self.c.tick()
            self.c.usart2_handler()

    def receive(self, data: bytes) -> None:
        """Bytes to its serial port."""
        self.arrived += data
        self.c.usart2_handler()

    def wrong(self) -> None:
        """A fault: the handler, until it waits for the watchdog."""
        self.c.wrong()
