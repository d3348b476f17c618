#include "frame.h"
#include "internal.h"

/* Whether these limits are no wider than the node's own for that output. */
static int within(const node_config *c, const node_output *o, const uint8_t *b)
{
    int32_t max_angle = signed32(get32(b + 12)), max_jump = signed32(get32(b + 16));
    return b[0] < c->n_encoder && b[1] == 0 && get16(b + 2) >> c->n_adc == 0 &&
           get16(b + 8) <= o->max_output && get16(b + 10) <= o->max_step && max_angle >= 0 &&
           max_jump >= 0 && max_jump <= o->max_jump;
}

/* Loop and limits of all outputs, or of none. */
static uint8_t configure(node_t *node, const uint8_t *b)
{
    const node_config *c = &node->config;
    if (node_active(node)) {
        return NOT_NULL;
    }
    if (node->state == NODE_TRIPPED) {
        return STATE;
    }
    for (unsigned o = 0; o < c->n_output; o++) {
        if (!within(c, &c->output[o], b + LIMITS * o)) {
            return LIMIT;
        }
    }
    for (unsigned o = 0; o < c->n_output; o++, b += LIMITS) {
        node_loop *loop = &node->loop[o];
        loop->encoder = b[0];
        loop->adc_mask = get16(b + 2);
        loop->kp_q16 = signed32(get32(b + 4));
        loop->max_output = get16(b + 8);
        loop->max_step = get16(b + 10);
        loop->max_angle = signed32(get32(b + 12));
        loop->max_jump = signed32(get32(b + 16));
        loop->centre = loop->last_ref = signed32(get32(b + 20));
    }
    node->configured = 1;
    node_to_null(node, NODE_IDLE, CONFIGURED);
    return OK;
}

static uint8_t stream(node_t *node, const uint8_t *b)
{
    /* Samples that are over have a distance of half the range or more. */
    uint32_t first = get32(b), n = b[4], accepted = 0;
    if (!node->configured) {
        return STATE;
    }
    uint32_t last = first + (n - 1u) - node->sample;
    if (last >= 0x80000000u) {
        return LATE;
    }
    if (last >= NODE_QUEUE) {
        return QUEUE;
    }
    b += 5;
    for (uint32_t i = 0; i < n; i++, b += REFERENCE * node->config.n_output) {
        uint32_t sample = first + i;
        if (sample - node->sample >= NODE_QUEUE) {
            continue;
        }
        node_slot *slot = &node->queue[sample % NODE_QUEUE];
        node->queued = (uint16_t)(node->queued + (slot->full ? 0u : 1u));
        for (unsigned o = 0; o < node->config.n_output; o++) {
            slot->u[o] = signed16(get16(b + REFERENCE * o));
            slot->theta_ref[o] = signed32(get32(b + REFERENCE * o + 2));
        }
        slot->full = 1;
        accepted++;
    }
    node->age = 0;
    return accepted == n ? OK : LATE;
}

static uint8_t clear(node_t *node)
{
    if (node->state != NODE_TRIPPED) {
        return OK;
    }
    if (node->emergency || node->adc_out) {
        return CAUSE;
    }
    node_to_null(node, NODE_IDLE, CLEARED);
    return OK;
}

/* Whether a body of n bytes is as long as its type has it, for so many outputs. */
static int length_fits(uint8_t type, const uint8_t *body, size_t n, size_t outputs)
{
    switch (type) {
    case IDENTIFY:
    case ZERO:
    case CLEAR:
        return n == 0;
    case CONFIGURE:
        return n == LIMITS * outputs;
    case STREAM:
        return n >= 5 && body[4] >= 1 && n == 5u + REFERENCE * outputs * body[4];
    default:
        return 0;
    }
}

/* A frame without its COBS; returns whether it was one to act on. */
static int handle(node_t *node, const uint8_t *p, size_t n)
{
    if (n < HEADER + CRC || n > NODE_MAX_PAYLOAD || get32(p + n - CRC) != frame_crc(p, n - CRC)) {
        return 0;
    }
    const uint8_t *body = p + HEADER;
    uint8_t type = p[1], code = OK;
    uint32_t seq = get32(p + 4);
    if (type == IDENTIFY && n == HEADER + CRC) {
        /* In any version, so that a host of another one learns which this is. */
        send_hello(node);
        return 1;
    }
    if (p[0] != node_version(node) ||
        !length_fits(type, body, n - HEADER - CRC, node->config.n_output) || get16(p + 2) != node->boot || seq - node->host_seq - 1u >= 0x7FFFFFFFu) {
        return 0;
    }
    node->host_seq = seq;
    switch (type) {
    case CONFIGURE:
        code = configure(node, body);
        break;
    case STREAM:
        code = stream(node, body);
        break;
    case ZERO:
        node_to_null(node, node->state == NODE_TRIPPED ? NODE_TRIPPED : NODE_IDLE, ZEROED);
        break;
    default:
        code = clear(node);
        break;
    }
    if (type != STREAM || code != OK) {
        send_answer(node, type, code);
    }
    return 1;
}

void node_rx(node_t *node, const uint8_t *bytes, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        if (bytes[i] != 0) {
            if (node->rx_length < NODE_MAX_ENCODED) {
                node->rx[node->rx_length++] = bytes[i];
            } else {
                node->rx_overlong = 1;
            }
            continue;
        }
        if (node->rx_length > 0) {
            if (node->rx_overlong || !handle(node, node->rx, frame_unstuff(node->rx, node->rx_length))) {
                node->rejected++;
            }
        }
        node->rx_length = 0;
        node->rx_overlong = 0;
    }
}
