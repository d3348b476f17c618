/* What stands between the node's core and the chip.
 *
 * main.c, wire.c, ticks.c and startup.c are the same on every board. The rest is one file for each:
 * board_stm32f405.c for the chip, board_qemu.c where an emulator has no pins.
 */
#ifndef SAMII_RIG_PORT_H
#define SAMII_RIG_PORT_H

#include <stddef.h>
#include <stdint.h>

#include "node.h"

#define APB1_HZ 42000000u /* of serial port and converters' bus */
#define TIMER_HZ 84000000u /* of the timers on it: RM0090, 7.2 */

/* board_*.c. What the board is; the clock at its full rate, the converters ready, all outputs at
 * null, the supply line off. Does not return if something of that cannot be had. */
const node_config *board_start(void);
/* Number of this boot: not 0, another one than before the last reset. */
uint16_t board_boot(void);
/* Counts of all inputs and the time in us, now. */
uint32_t board_sense(int32_t *encoders, int16_t *adcs);
/* Whether the emergency input is open. */
int board_emergency(void);
/* Of each output. */
void board_put(const int16_t *counts);
void board_supply(int on);
/* All outputs at null, then the supply line off, whatever went on before: for the handlers of what is wrong. */
void board_null(void);

/* wire.c: bytes of the serial port. */
void wire_start(uint32_t baud);
/* At most `room` bytes that came; returns how many. */
size_t wire_take(uint8_t *bytes, size_t room);
/* How many more bytes wire_give takes. */
size_t wire_room(void);
void wire_give(const uint8_t *bytes, size_t n);
/* How many came and how many went since the start, mod 2^32. */
uint32_t wire_came(void);
uint32_t wire_went(void);

/* ticks.c: the sample timer and the watchdog, which resets within_ms after it was fed last. */
void ticks_start(uint32_t period_ns);
void ticks_take(void);
void watchdog_start(uint16_t within_ms);
void watchdog_feed(void);

/* main.c: what came goes to the core; what is wrong ends at null, until the watchdog resets. */
extern node_t node;
void node_receive(void);
void fault_handler(void);

#endif
