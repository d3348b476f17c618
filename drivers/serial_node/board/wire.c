/* The serial port (USART2), by interrupt.
 *
 * DMA would do as well on the chip, but no emulator has it: by interrupt the code that is tested is
 * the code that is flashed. A byte costs 0.3 us of the processor, 921600 baud 3 % of it each way.
 */
#include "port.h"
#include "stm32f405.h"

#define SIZE 2048u /* bytes each way; a power of two. 22 ms of 921600 baud, a sample is shorter */
#define PRIORITY_PORT 0x20u /* above the sample's: see ticks.c */

typedef struct {
    volatile uint8_t bytes[SIZE]; /* each is there before it is counted */
    volatile uint32_t in, out; /* how many went in and came out, mod 2^32 */
} ring;

static ring from_host, to_host;

void wire_start(uint32_t baud)
{
    reg_set(USART2_BRR, (APB1_HZ + baud / 2u) / baud);
    reg_set(USART2_CR1, USART_CR1_UE | USART_CR1_TE | USART_CR1_RE | USART_CR1_RXNEIE);
    reg_field(NVIC_IPR(IRQ_USART2), 0xFFu << 8u * (IRQ_USART2 % 4u),
              PRIORITY_PORT << 8u * (IRQ_USART2 % 4u));
    reg_set(NVIC_ISER(IRQ_USART2), NVIC_BIT(IRQ_USART2));
}

void usart2_handler(void);
void usart2_handler(void)
{
    while (reg_get(USART2_SR) & USART_SR_RXNE) {
        uint8_t byte = (uint8_t)reg_get(USART2_DR);
        /* A full ring loses bytes as a line does; the frame's crc shows it. */
        if (from_host.in - from_host.out < SIZE) {
            from_host.bytes[from_host.in % SIZE] = byte;
            from_host.in++;
        }
    }
    while (to_host.in != to_host.out && reg_get(USART2_SR) & USART_SR_TXE) {
        reg_set(USART2_DR, to_host.bytes[to_host.out % SIZE]);
        to_host.out++;
    }
    reg_field(USART2_CR1, USART_CR1_TXEIE, to_host.in != to_host.out ? USART_CR1_TXEIE : 0u);
}

size_t wire_take(uint8_t *bytes, size_t room)
{
    size_t n = 0;
    while (n < room && from_host.in != from_host.out) {
        bytes[n++] = from_host.bytes[from_host.out % SIZE];
        from_host.out++;
    }
    return n;
}

size_t wire_room(void)
{
    return SIZE - (to_host.in - to_host.out);
}

void wire_give(const uint8_t *bytes, size_t n)
{
    for (size_t i = 0; i < n; i++) {
        to_host.bytes[to_host.in % SIZE] = bytes[i];
        to_host.in++;
    }
    if (n > 0) {
        /* The handler begins to send; it alone touches the port. */
        reg_set(NVIC_ISPR(IRQ_USART2), NVIC_BIT(IRQ_USART2));
    }
}

uint32_t wire_came(void)
{
    return from_host.in;
}

uint32_t wire_went(void)
{
    return to_host.out;
}
