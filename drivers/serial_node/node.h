/* Serial I/O node, protocol version 1: the portable part of the firmware.
 *
 * The protocol is docs/serial-node.md of samii-rig. This part holds everything that decides about
 * the output; what is left to the board is a timer, the converters, a serial port and one word of
 * memory that survives a reset:
 *
 *     node_init(&node, &config, ++boot_counter);      then put config.null_counts out
 *     for each byte block that came:  node_rx(&node, bytes, n);
 *     on each tick of the sample timer:
 *         dac(node_sample(&node, microseconds(), encoders, adcs, emergency_pin()));
 *         supply_pin(node_supply(&node));
 *     whenever the port takes bytes:  n = node_tx(&node, buffer, sizeof buffer);
 *
 * C99, no allocation, no floating point. The functions are not reentrant: call them from one
 * priority, or with the sample timer's interrupt held off. A hardware watchdog must reset the board
 * when node_sample is not called for the deadman's time; the reset leaves the output at null.
 */
#ifndef SAMII_RIG_NODE_H
#define SAMII_RIG_NODE_H

#include <stddef.h>
#include <stdint.h>

#define NODE_VERSION 1u
#define NODE_MAX_PAYLOAD 512u /* bytes of a frame before COBS */
#define NODE_MAX_ENCODED (NODE_MAX_PAYLOAD + NODE_MAX_PAYLOAD / 254u + 1u)
#define NODE_MAX_ENCODERS 4u
#define NODE_MAX_ADCS 8u
#define NODE_MAX_BATCH 8u
#define NODE_QUEUE 256u /* samples of reference; a power of two, as sample numbers wrap */
#define NODE_TX 2048u

enum node_state { NODE_IDLE, NODE_LIVE, NODE_DRY, NODE_DEAD, NODE_TRIPPED };

/* What the board is; the limits here are hard, CONFIGURE can only ask for less. Counts of the
 * output are counted from null_counts. */
typedef struct {
    uint32_t period_ns;
    uint16_t deadman_ms;
    uint8_t n_encoder, n_adc, batch;
    int16_t dac_low, dac_high, null_counts;
    uint16_t max_output, max_step;
    int32_t max_jump;
    char firmware[16], serial[16];
} node_config;

typedef struct {
    int16_t u;
    int32_t theta_ref;
    uint8_t full;
} node_slot;

typedef struct {
    node_config config;
    uint16_t boot, rejected, queued;
    uint32_t seq, host_seq, sample;
    uint8_t state, configured, emergency, adc_out, seen;
    /* CONFIGURE */
    uint8_t encoder;
    uint16_t adc_mask, max_output, max_step;
    int32_t kp_q16, max_angle, max_jump, centre;
    /* loop */
    uint32_t age, patience;
    int32_t last_v, last_ref;
    int32_t last_encoder[NODE_MAX_ENCODERS];
    node_slot queue[NODE_QUEUE];
    /* the SAMPLES frame that fills */
    uint32_t batch_first, batch_clock;
    uint8_t batch_n;
    uint16_t batch_length;
    uint8_t batch[NODE_MAX_PAYLOAD];
    /* bytes */
    uint8_t rx[NODE_MAX_ENCODED];
    uint16_t rx_length;
    uint8_t rx_overlong;
    uint8_t tx[NODE_TX];
    uint16_t tx_start, tx_length;
} node_t;

/* At boot: output at null, HELLO on its way. boot is not 0 and differs from the last one. */
void node_init(node_t *node, const node_config *config, uint16_t boot);

/* Bytes from the host. */
void node_rx(node_t *node, const uint8_t *bytes, size_t n);

/* One sample: returns the counts to put out now. clock_us is free running and wraps. */
int16_t node_sample(node_t *node, uint32_t clock_us, const int32_t *encoders,
                    const int16_t *adcs, int emergency);

/* Whether the supply line is on: the board sets it after each node_sample's counts are out, so that
 * the valve is at null before its supply goes. Off at boot. */
int node_supply(const node_t *node);

/* Bytes to the host: fills at most room bytes, returns how many. */
size_t node_tx(node_t *node, uint8_t *buffer, size_t room);

#endif
