#include "frame.h"
#include "internal.h"

static uint8_t configure(node_t *node, const uint8_t *b)
{
    uint16_t mask = get16(b + 2), max_output = get16(b + 8), max_step = get16(b + 10);
    int32_t max_angle = signed32(get32(b + 12)), max_jump = signed32(get32(b + 16));
    if (node_active(node)) {
        return NOT_NULL;
    }
    if (node->state == NODE_TRIPPED) {
        return STATE;
    }
    if (b[0] >= node->config.n_encoder || b[1] != 0 || mask >> node->config.n_adc != 0 ||
        max_output > node->config.max_output || max_step > node->config.max_step ||
        max_angle < 0 || max_jump < 0 || max_jump > node->config.max_jump) {
        return LIMIT;
    }
    node->encoder = b[0];
    node->adc_mask = mask;
    node->kp_q16 = signed32(get32(b + 4));
    node->max_output = max_output;
    node->max_step = max_step;
    node->max_angle = max_angle;
    node->max_jump = max_jump;
    node->centre = node->last_ref = signed32(get32(b + 20));
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
    for (uint32_t i = 0; i < n; i++) {
        uint32_t sample = first + i;
        if (sample - node->sample >= NODE_QUEUE) {
            continue;
        }
        node_slot *slot = &node->queue[sample % NODE_QUEUE];
        node->queued = (uint16_t)(node->queued + (slot->full ? 0u : 1u));
        slot->u = signed16(get16(b + 5 + 6 * i));
        slot->theta_ref = signed32(get32(b + 7 + 6 * i));
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

/* Whether a body of n bytes is as long as its type has it. */
static int length_fits(uint8_t type, const uint8_t *body, size_t n)
{
    switch (type) {
    case IDENTIFY:
    case ZERO:
    case CLEAR:
        return n == 0;
    case CONFIGURE:
        return n == 24;
    case STREAM:
        return n >= 5 && body[4] >= 1 && n == 5u + 6u * body[4];
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
    if (p[0] != NODE_VERSION || !length_fits(type, body, n - HEADER - CRC) ||
        get16(p + 2) != node->boot || seq - node->host_seq - 1u >= 0x7FFFFFFFu) {
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
