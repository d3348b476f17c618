#include "node.h"

#include "frame.h"
#include "internal.h"

#include <string.h>

void node_change(node_t *node, uint8_t state, uint8_t reason)
{
    uint8_t before = node->state;
    node->state = state;
    if (state != before) {
        send_event(node, reason);
    }
}

void node_to_null(node_t *node, uint8_t state, uint8_t reason)
{
    for (size_t i = 0; i < NODE_QUEUE; i++) {
        node->queue[i].full = 0;
    }
    node->queued = 0;
    node->last_v = 0;
    if (state == NODE_DEAD || state == NODE_TRIPPED) {
        node->configured = 0;
    }
    node_change(node, state, reason);
}

int node_active(const node_t *node)
{
    return node->state == NODE_LIVE || node->state == NODE_DRY;
}

/* Round (kp difference) / 2^16 to the nearest, halves up. */
static int64_t scaled(int32_t kp_q16, int64_t difference)
{
    int64_t x = (int64_t)kp_q16 * difference + 0x8000;
    return x >= 0 ? x / 0x10000 : -((-x + 0xFFFF) / 0x10000);
}

int node_supply(const node_t *node)
{
    return node_active(node);
}

static int64_t distance(int32_t a, int32_t b)
{
    int64_t d = (int64_t)a - b;
    return d < 0 ? -d : d;
}

static int64_t clamp(int64_t x, int64_t low, int64_t high)
{
    return x < low ? low : x > high ? high : x;
}

/* What this sample's inputs say is wrong: flags, and a reason to trip while the output is live. */
static uint8_t judge(node_t *node, const int32_t *encoders, const int16_t *adcs, uint8_t *flags)
{
    uint8_t reason = 0, e = node->encoder;
    node->adc_out = 0;
    for (unsigned i = 0; i < node->config.n_adc; i++) {
        if (adcs[i] == INT16_MIN || adcs[i] == INT16_MAX) {
            *flags |= F_ADC;
            if (node->adc_mask >> i & 1u) {
                node->adc_out = 1;
                reason = ADC;
            }
        }
    }
    if (node->configured && distance(encoders[e], node->centre) > node->max_angle) {
        *flags |= F_ANGLE;
        reason = ANGLE;
    }
    if (node->configured && node->seen &&
        distance(encoders[e], node->last_encoder[e]) > node->max_jump) {
        *flags |= F_JUMP;
        reason = JUMP;
    }
    memcpy(node->last_encoder, encoders, sizeof encoders[0] * node->config.n_encoder);
    node->seen = 1;
    return reason;
}

static void report(node_t *node, uint32_t clock_us, int16_t u, uint8_t flags,
                   const int32_t *encoders, const int16_t *adcs)
{
    if (node->batch_n == 0) {
        node->batch_first = node->sample;
        node->batch_clock = clock_us;
        node->batch_length = HEADER + SAMPLES_HEAD;
    }
    uint8_t *p = node->batch + node->batch_length;
    put16(p, (uint16_t)node->last_v);
    put16(p + 2, (uint16_t)u);
    put32(p + 4, (uint32_t)node->last_ref);
    p[8] = flags;
    p += 9;
    for (unsigned i = 0; i < node->config.n_encoder; i++, p += 4) {
        put32(p, (uint32_t)encoders[i]);
    }
    for (unsigned i = 0; i < node->config.n_adc; i++, p += 2) {
        put16(p, (uint16_t)adcs[i]);
    }
    node->batch_length = (uint16_t)(p - node->batch);
    node->batch_n++;
    if (node->batch_n == node->config.batch) {
        uint8_t *head = node->batch + HEADER;
        put32(head, node->batch_first);
        put32(head + 4, node->batch_clock);
        head[8] = node->batch_n;
        head[9] = node->state;
        put16(head + 10, node->rejected);
        put16(head + 12, node->queued);
        send_frame(node, SAMPLES, node->batch, (size_t)node->batch_length - HEADER);
        node->batch_n = 0;
    }
}

int16_t node_sample(node_t *node, uint32_t clock_us, const int32_t *encoders,
                    const int16_t *adcs, int emergency)
{
    uint8_t flags = 0, reason = judge(node, encoders, adcs, &flags);
    node->emergency = emergency != 0;
    if (node->emergency) {
        flags |= F_EMERGENCY;
        node_to_null(node, NODE_TRIPPED, EMERGENCY);
    }
    if (node_active(node) || node->queued > 0) {
        node->age++;
        if (node->age >= node->patience) {
            node_to_null(node, NODE_DEAD, DEADMAN);
        }
    }
    node_slot *slot = &node->queue[node->sample % NODE_QUEUE];
    int16_t u = 0;
    if (slot->full) {
        slot->full = 0;
        node->queued--;
        u = slot->u;
        node->last_ref = slot->theta_ref;
        flags |= F_REFERENCE;
        node_change(node, NODE_LIVE, STARTED);
    } else if (node->state == NODE_LIVE) {
        node_change(node, NODE_DRY, RAN_DRY);
    }
    if (node_active(node) && reason != 0) {
        node_to_null(node, NODE_TRIPPED, reason);
    }
    if (node_active(node)) {
        flags |= F_SUPPLY;
        const node_config *c = &node->config;
        int64_t most = node->max_output, step = node->max_step;
        int64_t wanted =
            u + scaled(node->kp_q16, (int64_t)node->last_ref - encoders[node->encoder]);
        int64_t v = clamp(wanted, node->last_v - step, node->last_v + step);
        v = clamp(clamp(v, -most, most), c->dac_low - c->null_counts, c->dac_high - c->null_counts);
        flags |= v != wanted ? F_LIMITED : 0;
        node->last_v = (int32_t)v;
    } else {
        flags |= F_NULL;
        flags |= node->state == NODE_IDLE ? 0 : F_LIMITED;
    }
    report(node, clock_us, u, flags, encoders, adcs);
    node->sample++;
    return (int16_t)(node->last_v + node->config.null_counts);
}

void node_init(node_t *node, const node_config *config, uint16_t boot)
{
    memset(node, 0, sizeof *node);
    node->config = *config;
    node->boot = boot;
    node->patience = (uint32_t)((uint64_t)config->deadman_ms * 1000000u / config->period_ns);
    send_hello(node);
}
