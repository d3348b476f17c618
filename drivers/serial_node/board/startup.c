/* From the reset to main, and where the processor goes when something is wrong. */
#include "port.h"
#include "stm32f405.h"

#define N_IRQ 82u /* of the STM32F405: RM0090, table 61 */
#define CORE 16u

extern uint32_t stack_top[], data_from[], data_start[], data_end[], bss_start[], bss_end[];

int main(void);
void tim4_handler(void);
void usart2_handler(void);

typedef void (*handler)(void);

typedef struct {
    uint32_t *stack;
    handler handlers[CORE - 1u + N_IRQ];
} table;

extern const table vectors;

__attribute__((noreturn)) void reset_handler(void);
void reset_handler(void)
{
    reg_set(SCB_VTOR, (uint32_t)&vectors); /* a boot loader may have left its own */
    const uint32_t *from = data_from;
    for (uint32_t *to = data_start; to < data_end;) {
        *to++ = *from++;
    }
    for (uint32_t *to = bss_start; to < bss_end;) {
        *to++ = 0;
    }
    main();
    fault_handler();
    for (;;) {
    }
}

/* Every fault, NMI (the crystal stopped: RM0090, 7.2.7), a supply that drops, and every interrupt
 * that nobody asked for. On a fresh stack, with all else held off. */
__attribute__((naked)) void wrong_handler(void);
void wrong_handler(void)
{
    __asm volatile("cpsid i\n"
                   "ldr r0, =stack_top\n"
                   "mov sp, r0\n"
                   "b fault_handler\n");
}

__attribute__((section(".vectors"), used)) const table vectors = {
    stack_top,
    {
        reset_handler,
        [1 ... CORE - 2u + IRQ_TIM4] = wrong_handler,
        [CORE - 1u + IRQ_TIM4] = tim4_handler,
        [CORE + IRQ_TIM4 ... CORE - 2u + IRQ_USART2] = wrong_handler,
        [CORE - 1u + IRQ_USART2] = usart2_handler,
        [CORE + IRQ_USART2 ... CORE - 2u + N_IRQ] = wrong_handler,
    },
};
