#include "node.h"

#include "frame.h"
#include "internal.h"

#include <string.h>

/* A frame of samples is never longer than a payload: the array has a negative size if it were. */
typedef char frame_fits[HEADER + SAMPLES_HEAD + CRC +
                                    NODE_MAX_BATCH * (REPORTED * NODE_MAX_OUTPUTS +
                                                      4u * NODE_MAX_ENCODERS + 2u * NODE_MAX_ADCS) <=
                                NODE_MAX_PAYLOAD
                            ? 1
                            : -1];

uint8_t node_version(const node_t *node)
{
    return node->config.n_output == 1 ? NODE_VERSION_ONE : NODE_VERSION_SEVERAL;
}

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
    for (unsigned o = 0; o < NODE_MAX_OUTPUTS; o++) {
        node->loop[o].last_v = 0;
    }
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

static void flag_all(const node_t *node, uint8_t *flags, uint8_t flag)
{
    for (unsigned o = 0; o < node->config.n_output; o++) {
        flags[o] = (uint8_t)(flags[o] | flag);
    }
}

/* What this sample's inputs say is wrong: flags of each output, and a reason to trip while they are
 * live. One output's reason is that of all. */
static uint8_t judge(node_t *node, const int32_t *encoders, const int16_t *adcs, uint8_t *flags)
{
    uint8_t reason = 0;
    uint16_t watched = 0;
    for (unsigned o = 0; o < node->config.n_output; o++) {
        watched = (uint16_t)(watched | node->loop[o].adc_mask);
    }
    node->adc_out = 0;
    for (unsigned i = 0; i < node->config.n_adc; i++) {
        if (adcs[i] == INT16_MIN || adcs[i] == INT16_MAX) {
            flag_all(node, flags, F_ADC);
            if (watched >> i & 1u) {
                node->adc_out = 1;
                reason = ADC;
            }
        }
    }
    for (unsigned o = 0; o < node->config.n_output && node->configured; o++) {
        const node_loop *loop = &node->loop[o];
        int32_t angle = encoders[loop->encoder];
        if (distance(angle, loop->centre) > loop->max_angle) {
            flags[o] |= F_ANGLE;
            reason = ANGLE;
        }
        if (node->seen && distance(angle, node->last_encoder[loop->encoder]) > loop->max_jump) {
            flags[o] |= F_JUMP;
            reason = JUMP;
        }
    }
    memcpy(node->last_encoder, encoders, sizeof encoders[0] * node->config.n_encoder);
    node->seen = 1;
    return reason;
}

static void report(node_t *node, uint32_t clock_us, const int16_t *u, const uint8_t *flags,
                   const int32_t *encoders, const int16_t *adcs)
{
    if (node->batch_n == 0) {
        node->batch_first = node->sample;
        node->batch_clock = clock_us;
        node->batch_length = HEADER + SAMPLES_HEAD;
    }
    uint8_t *p = node->batch + node->batch_length;
    for (unsigned o = 0; o < node->config.n_output; o++, p += REPORTED) {
        put16(p, (uint16_t)node->loop[o].last_v);
        put16(p + 2, (uint16_t)u[o]);
        put32(p + 4, (uint32_t)node->loop[o].last_ref);
        p[8] = flags[o];
    }
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

/* The next output of one loop, from its reference u; whether it is another than the loop's. */
static int follow(node_loop *loop, const node_output *o, int16_t u, const int32_t *encoders)
{
    int64_t most = loop->max_output, step = loop->max_step;
    int64_t wanted = u + scaled(loop->kp_q16, (int64_t)loop->last_ref - encoders[loop->encoder]);
    int64_t v = clamp(wanted, loop->last_v - step, loop->last_v + step);
    v = clamp(clamp(v, -most, most), o->dac_low - o->null_counts, o->dac_high - o->null_counts);
    loop->last_v = (int32_t)v;
    return v != wanted;
}

void node_sample(node_t *node, uint32_t clock_us, const int32_t *encoders, const int16_t *adcs,
                 int emergency, int16_t *counts)
{
    const node_config *c = &node->config;
    uint8_t flags[NODE_MAX_OUTPUTS] = {0}, reason = judge(node, encoders, adcs, flags);
    node->emergency = emergency != 0;
    if (node->emergency) {
        flag_all(node, flags, F_EMERGENCY);
        node_to_null(node, NODE_TRIPPED, EMERGENCY);
    }
    if (node_active(node) || node->queued > 0) {
        node->age++;
        if (node->age >= node->patience) {
            node_to_null(node, NODE_DEAD, DEADMAN);
        }
    }
    node_slot *slot = &node->queue[node->sample % NODE_QUEUE];
    int16_t u[NODE_MAX_OUTPUTS] = {0};
    if (slot->full) {
        slot->full = 0;
        node->queued--;
        for (unsigned o = 0; o < c->n_output; o++) {
            u[o] = slot->u[o];
            node->loop[o].last_ref = slot->theta_ref[o];
        }
        flag_all(node, flags, F_REFERENCE);
        node_change(node, NODE_LIVE, STARTED);
    } else if (node->state == NODE_LIVE) {
        node_change(node, NODE_DRY, RAN_DRY);
    }
    if (node_active(node) && reason != 0) {
        node_to_null(node, NODE_TRIPPED, reason);
    }
    if (node_active(node)) {
        flag_all(node, flags, F_SUPPLY);
        for (unsigned o = 0; o < c->n_output; o++) {
            if (follow(&node->loop[o], &c->output[o], u[o], encoders)) {
                flags[o] |= F_LIMITED;
            }
        }
    } else {
        flag_all(node, flags, node->state == NODE_IDLE ? F_NULL : F_NULL | F_LIMITED);
    }
    report(node, clock_us, u, flags, encoders, adcs);
    node->sample++;
    for (unsigned o = 0; o < c->n_output; o++) {
        counts[o] = (int16_t)(node->loop[o].last_v + c->output[o].null_counts);
    }
}

void node_init(node_t *node, const node_config *config, uint16_t boot)
{
    memset(node, 0, sizeof *node);
    node->config = *config;
    node->boot = boot;
    node->patience = (uint32_t)((uint64_t)config->deadman_ms * 1000000u / config->period_ns);
    send_hello(node);
}
