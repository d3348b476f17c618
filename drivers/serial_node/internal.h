/* What the parts of the node share; nothing for the board. */
#ifndef SAMII_RIG_INTERNAL_H
#define SAMII_RIG_INTERNAL_H

#include "node.h"

enum { HELLO = 1, SAMPLES, EVENT, ANSWER };
enum { IDENTIFY = 16, CONFIGURE, STREAM, ZERO, CLEAR };
enum { OK, NOT_NULL, LIMIT, STATE, LATE, QUEUE, CAUSE };
enum { STARTED = 1, RAN_DRY, DEADMAN, ANGLE, JUMP, ADC, EMERGENCY, ZEROED, CLEARED, CONFIGURED };
enum {
    F_LIMITED = 1,
    F_REFERENCE = 2,
    F_ADC = 4,
    F_JUMP = 8,
    F_ANGLE = 16,
    F_EMERGENCY = 32,
    F_NULL = 64,
    F_SUPPLY = 128
};
enum { HEADER = 8, CRC = 4, SAMPLES_HEAD = 14, REPORTED = 9 };
/* Bytes of CONFIGURE and of a STREAM's sample, for each output; of HELLO, and of it for each more. */
enum { LIMITS = 24, REFERENCE = 6, HELLO_ONE = 62, HELLO_MORE = 14 };

/* Send a payload whose body of n bytes stands behind HEADER bytes, with CRC bytes free after it. A
 * frame that finds no room is dropped whole; its number shows the host that it is missing. */
void send_frame(node_t *node, uint8_t type, uint8_t *payload, size_t n);
void send_hello(node_t *node);
void send_event(node_t *node, uint8_t reason);
void send_answer(node_t *node, uint8_t type, uint8_t code);

/* Go to a state, and say so if it is another one. */
void node_change(node_t *node, uint8_t state, uint8_t reason);

/* All outputs at null from now on: nothing queued, the loops open. */
void node_to_null(node_t *node, uint8_t state, uint8_t reason);

/* Whether the outputs follow their loops. */
int node_active(const node_t *node);

/* The protocol's version that this node speaks. */
uint8_t node_version(const node_t *node);

#endif
