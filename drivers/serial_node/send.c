#include "frame.h"
#include "internal.h"

#include <string.h>

static void tx_byte(node_t *node, uint8_t byte)
{
    node->tx[(node->tx_start + node->tx_length) % NODE_TX] = byte;
    node->tx_length++;
}

void send_frame(node_t *node, uint8_t type, uint8_t *payload, size_t n)
{
    size_t length = HEADER + n + CRC;
    payload[0] = node_version(node);
    payload[1] = type;
    put16(payload + 2, node->boot);
    put32(payload + 4, node->seq++);
    put32(payload + HEADER + n, frame_crc(payload, HEADER + n));
    if (node->tx_length + length + length / 254u + 2u > NODE_TX) {
        return;
    }
    uint8_t stuffed[NODE_MAX_ENCODED];
    size_t n_stuffed = frame_stuff(stuffed, payload, length);
    for (size_t i = 0; i < n_stuffed; i++) {
        tx_byte(node, stuffed[i]);
    }
    tx_byte(node, 0);
}

/* What the converter of an output can do, and the node's own limits: 10 bytes. */
static void put_output(uint8_t *p, const node_output *o)
{
    put16(p, (uint16_t)o->dac_low);
    put16(p + 2, (uint16_t)o->dac_high);
    put16(p + 4, (uint16_t)o->null_counts);
    put16(p + 6, o->max_output);
    put16(p + 8, o->max_step);
}

void send_hello(node_t *node)
{
    uint8_t payload[HEADER + HELLO_ONE + 1 + HELLO_MORE * (NODE_MAX_OUTPUTS - 1) + CRC];
    uint8_t *p = payload + HEADER;
    const node_config *c = &node->config;
    const node_output *first = &c->output[0];
    put32(p, c->period_ns);
    put16(p + 4, c->deadman_ms);
    p[6] = c->n_encoder;
    p[7] = c->n_adc;
    p[8] = c->batch;
    p[9] = node->state;
    put_output(p + 10, first);
    put16(p + 20, (uint16_t)NODE_QUEUE);
    put32(p + 22, (uint32_t)first->max_jump);
    put32(p + 26, node->host_seq);
    memcpy(p + 30, c->firmware, sizeof c->firmware);
    memcpy(p + 46, c->serial, sizeof c->serial);
    size_t n = HELLO_ONE;
    if (c->n_output > 1) {
        p[n++] = c->n_output;
        for (unsigned o = 1; o < c->n_output; o++, n += HELLO_MORE) {
            put_output(p + n, &c->output[o]);
            put32(p + n + 10, (uint32_t)c->output[o].max_jump);
        }
    }
    send_frame(node, HELLO, payload, n);
}

void send_event(node_t *node, uint8_t reason)
{
    uint8_t payload[HEADER + 6 + CRC];
    put32(payload + HEADER, node->sample);
    payload[HEADER + 4] = node->state;
    payload[HEADER + 5] = reason;
    send_frame(node, EVENT, payload, 6);
}

void send_answer(node_t *node, uint8_t type, uint8_t code)
{
    uint8_t payload[HEADER + 6 + CRC];
    put32(payload + HEADER, node->host_seq);
    payload[HEADER + 4] = type;
    payload[HEADER + 5] = code;
    send_frame(node, ANSWER, payload, 6);
}

size_t node_tx(node_t *node, uint8_t *buffer, size_t room)
{
    size_t n = node->tx_length < room ? node->tx_length : room;
    for (size_t i = 0; i < n; i++) {
        buffer[i] = node->tx[(node->tx_start + i) % NODE_TX];
    }
    node->tx_start = (uint16_t)((node->tx_start + n) % NODE_TX);
    node->tx_length = (uint16_t)(node->tx_length - n);
    return n;
}
