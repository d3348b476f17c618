/* What a frame is made of: little-endian integers, CRC-32, COBS. */
#ifndef SAMII_RIG_FRAME_H
#define SAMII_RIG_FRAME_H

#include <stddef.h>
#include <stdint.h>

void put16(uint8_t *p, uint16_t x);
void put32(uint8_t *p, uint32_t x);
uint16_t get16(const uint8_t *p);
uint32_t get32(const uint8_t *p);
int16_t signed16(uint16_t x);
int32_t signed32(uint32_t x);

/* CRC-32 of IEEE 802.3. */
uint32_t frame_crc(const uint8_t *p, size_t n);

/* COBS of p into out, at most n + n/254 + 1 bytes; returns how many. */
size_t frame_stuff(uint8_t *out, const uint8_t *p, size_t n);

/* Take the COBS off in place; returns the length, 0 for what is none. */
size_t frame_unstuff(uint8_t *p, size_t n);

#endif
