#include "frame.h"

void put16(uint8_t *p, uint16_t x)
{
    p[0] = (uint8_t)(x & 0xFFu);
    p[1] = (uint8_t)(x >> 8);
}

void put32(uint8_t *p, uint32_t x)
{
    put16(p, (uint16_t)(x & 0xFFFFu));
    put16(p + 2, (uint16_t)(x >> 16));
}

uint16_t get16(const uint8_t *p)
{
    return (uint16_t)(p[0] | ((unsigned)p[1] << 8));
}

uint32_t get32(const uint8_t *p)
{
    return get16(p) | ((uint32_t)get16(p + 2) << 16);
}

int16_t signed16(uint16_t x)
{
    return (int16_t)(x < 0x8000u ? (int32_t)x : (int32_t)x - 0x10000);
}

int32_t signed32(uint32_t x)
{
    return (int32_t)(x < 0x80000000u ? (int64_t)x : (int64_t)x - INT64_C(0x100000000));
}

uint32_t frame_crc(const uint8_t *p, size_t n)
{
    uint32_t crc = 0xFFFFFFFFu;
    while (n-- > 0) {
        crc ^= *p++;
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc >> 1) ^ (crc & 1u ? 0xEDB88320u : 0u);
        }
    }
    return ~crc;
}

size_t frame_stuff(uint8_t *out, const uint8_t *p, size_t n)
{
    size_t o = 0;
    for (size_t start = 0;;) {
        size_t end = start;
        while (end < n && p[end] != 0 && end - start < 254u) {
            end++;
        }
        out[o++] = (uint8_t)(end - start + 1u);
        for (size_t i = start; i < end; i++) {
            out[o++] = p[i];
        }
        if (end == n) {
            return o;
        }
        start = end - start == 254u ? end : end + 1u;
    }
}

size_t frame_unstuff(uint8_t *p, size_t n)
{
    size_t out = 0;
    for (size_t in = 0; in < n;) {
        size_t code = p[in];
        if (in + code > n) {
            return 0;
        }
        for (size_t i = 1; i < code; i++) {
            p[out++] = p[in + i];
        }
        in += code;
        if (code < 255u && in < n) {
            p[out++] = 0;
        }
    }
    return out;
}
