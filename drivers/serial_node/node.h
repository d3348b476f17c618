/* Serial I/O node: the portable part of the firmware. A node with one output speaks protocol version
 * 1, a node with several version 2.
 *
 * The protocol is docs/reference/serial-node-frames.md of samii-rig, what a node does at each sample
 * docs/reference/serial-node-states.md. This part holds everything that decides about the outputs;
 * what is left to the board is a timer, the converters, a serial port and one word of memory that
 * survives a reset:
 *
 *     node_init(&node, &config, ++boot_counter);      then put the null_counts of each output out
 *     for each byte block that came:  node_rx(&node, bytes, n);
 *     on each tick of the sample timer:
 *         node_sample(&node, microseconds(), encoders, adcs, emergency_pin(), counts);
 *         dac(counts);                                 of all outputs
 *         supply_pin(node_supply(&node));
 *     whenever the port takes bytes:  n = node_tx(&node, buffer, sizeof buffer);
 *
 * C99, no allocation, no floating point. The functions are not reentrant: call them from one
 * priority, or with the sample timer's interrupt held off. A hardware watchdog must reset the board
 * when node_sample is not called for the deadman's time; the reset leaves all outputs at null.
 */
#ifndef SAMII_RIG_NODE_H
#define SAMII_RIG_NODE_H

#include <stddef.h>
#include <stdint.h>

#define NODE_VERSION_ONE 1u     /* of a node with one output */
#define NODE_VERSION_SEVERAL 2u
#define NODE_MAX_PAYLOAD 512u /* bytes of a frame before COBS */
#define NODE_MAX_ENCODED (NODE_MAX_PAYLOAD + NODE_MAX_PAYLOAD / 254u + 1u)
#define NODE_MAX_OUTPUTS 3u /* eight samples of three outputs and all inputs fit a frame */
#define NODE_MAX_ENCODERS 4u
#define NODE_MAX_ADCS 8u
#define NODE_MAX_BATCH 8u
#define NODE_QUEUE 256u /* samples of reference; a power of two, as sample numbers wrap */
#define NODE_TX 2048u

enum node_state { NODE_IDLE, NODE_LIVE, NODE_DRY, NODE_DEAD, NODE_TRIPPED };

/* What an output is; the limits here are hard, CONFIGURE can only ask for less. Its counts are
 * counted from null_counts. */
typedef struct {
    int16_t dac_low, dac_high, null_counts;
    uint16_t max_output, max_step;
    int32_t max_jump; /* of the encoder that its loop closes on, in one sample */
} node_output;

/* What the board is. n_output is 1 to NODE_MAX_OUTPUTS. */
typedef struct {
    uint32_t period_ns;
    uint16_t deadman_ms;
    uint8_t n_output, n_encoder, n_adc, batch;
    node_output output[NODE_MAX_OUTPUTS];
    char firmware[16], serial[16];
} node_config;

/* One sample's reference, of all outputs. */
typedef struct {
    int16_t u[NODE_MAX_OUTPUTS];
    int32_t theta_ref[NODE_MAX_OUTPUTS];
    uint8_t full;
} node_slot;

/* Loop and limits of one output, of CONFIGURE, and what it did last. */
typedef struct {
    uint8_t encoder;
    uint16_t adc_mask, max_output, max_step;
    int32_t kp_q16, max_angle, max_jump, centre;
    int32_t last_v, last_ref;
} node_loop;

typedef struct {
    node_config config;
    uint16_t boot, rejected, queued;
    uint32_t seq, host_seq, sample;
    uint8_t state, configured, emergency, adc_out, seen;
    node_loop loop[NODE_MAX_OUTPUTS];
    uint32_t age, patience;
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

/* At boot: all outputs at null, HELLO on its way. boot is not 0 and differs from the last one. */
void node_init(node_t *node, const node_config *config, uint16_t boot);

/* Bytes from the host. */
void node_rx(node_t *node, const uint8_t *bytes, size_t n);

/* One sample: counts[n_output] are to be put out now. clock_us is free running and wraps. */
void node_sample(node_t *node, uint32_t clock_us, const int32_t *encoders, const int16_t *adcs,
                 int emergency, int16_t *counts);

/* Whether the supply line is on: the board sets it after each node_sample's counts are out, so that
 * the valve is at null before its supply goes. Off at boot. */
int node_supply(const node_t *node);

/* Bytes to the host: fills at most room bytes, returns how many. */
size_t node_tx(node_t *node, uint8_t *buffer, size_t room);

#endif
