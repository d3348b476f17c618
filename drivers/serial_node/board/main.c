/* The node on a board: one interrupt for each sample, and nothing else calls the core.
 *
 * A sample is sensed at the tick, judged and put out before anything is read from the host, so the
 * time from the inputs to the output does not depend on what the host sends.
 */
#include "node.h"
#include "port.h"
#include "stm32f405.h"

#define BAUD 921600u
#define PART 256u /* bytes moved at once, between core and port */

node_t node;

void node_receive(void)
{
    uint8_t bytes[PART];
    size_t n;
    while ((n = wire_take(bytes, sizeof bytes)) > 0) {
        node_rx(&node, bytes, n);
    }
}

static void send(void)
{
    uint8_t bytes[PART];
    size_t room, n;
    do {
        room = wire_room();
        n = node_tx(&node, bytes, room < sizeof bytes ? room : sizeof bytes);
        wire_give(bytes, n);
    } while (n > 0);
}

void tim4_handler(void);
void tim4_handler(void)
{
    int32_t encoders[NODE_MAX_ENCODERS];
    int16_t adcs[NODE_MAX_ADCS], counts[NODE_MAX_OUTPUTS];
    ticks_take();
    uint32_t clock_us = board_sense(encoders, adcs);
    node_sample(&node, clock_us, encoders, adcs, board_emergency(), counts);
    board_put(counts);
    board_supply(node_supply(&node)); /* after the converters: node.h */
    node_receive();
    send();
    watchdog_feed(); /* here alone: without samples, and without an end of one, the chip resets */
}

void fault_handler(void)
{
    board_null();
    for (;;) {
        wait_for_interrupt(); /* nothing feeds the watchdog any more: it resets */
    }
}

int main(void);
int main(void)
{
    const node_config *config = board_start();
    node_init(&node, config, board_boot());
    wire_start(BAUD);
    watchdog_start(config->deadman_ms);
    ticks_start(config->period_ns);
    for (;;) {
        wait_for_interrupt();
    }
}
