/* The sample timer (TIM4) and the independent watchdog. */
#include "port.h"
#include "stm32f405.h"

#define TICK_HZ 1000000u /* so that a period is a whole number of us, at most 65.5 ms */
#define NS_PER_TICK 1000u
#define LSI_SLOWEST_KHZ 17u /* datasheet: 17 to 47 kHz. At 47 the time is 36 % of this */
#define RELOAD_MOST 0xFFFu
#define UPDATE_WAITS 1000000u /* looks at the watchdog's own clock taking a number over: 0.2 ms */
/* 0 is the highest of 16. The port's handler is short and must not wait for a sample. */
#define PRIORITY_SAMPLE 0x40u

void ticks_start(uint32_t period_ns)
{
    reg_set(TIM_PSC(TIM4), TIMER_HZ / TICK_HZ - 1u);
    reg_set(TIM_ARR(TIM4), period_ns / NS_PER_TICK - 1u);
    reg_set(TIM_EGR(TIM4), TIM_EGR_UG); /* takes the divisor over now */
    reg_set(TIM_SR(TIM4), 0u);
    reg_set(TIM_DIER(TIM4), TIM_DIER_UIE);
    reg_field(NVIC_IPR(IRQ_TIM4), 0xFFu << 8u * (IRQ_TIM4 % 4u),
              PRIORITY_SAMPLE << 8u * (IRQ_TIM4 % 4u));
    reg_set(NVIC_ISER(IRQ_TIM4), NVIC_BIT(IRQ_TIM4));
    reg_set(TIM_CR1(TIM4), TIM_CR1_CEN);
}

void ticks_take(void)
{
    reg_set(TIM_SR(TIM4), 0u);
}

void watchdog_start(uint16_t within_ms)
{
    uint32_t cycles = within_ms * LSI_SLOWEST_KHZ;
    int slow = cycles / 4u > RELOAD_MOST;
    uint32_t reload = cycles / (slow ? 256u : 4u);
    reg_set(IWDG_KR, IWDG_KR_START); /* nothing but a reset ends it */
    for (uint32_t looks = UPDATE_WAITS; looks > 0 && reg_get(IWDG_SR) != 0; looks--) {
        /* Of the numbers before. */
    }
    reg_set(IWDG_KR, IWDG_KR_WRITE);
    reg_set(IWDG_PR, slow ? IWDG_PR_256 : IWDG_PR_4);
    reg_set(IWDG_RLR, reload > RELOAD_MOST ? RELOAD_MOST : reload);
    watchdog_feed();
}

void watchdog_feed(void)
{
    reg_set(IWDG_KR, IWDG_KR_FEED);
}
