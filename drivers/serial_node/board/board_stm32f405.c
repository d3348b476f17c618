/* The chip itself: clocks, pins, converters, encoders, the number of the boot.
 *
 * Outputs: an AD5761R for each, 16 bit, +-10 V. Their RESET is pulled to ground by one resistor, and the
 * supply line by another: while the chip is in reset, they hold their outputs at ground and the supply
 * is off.
 * Inputs: ADS8688, 8 of 16 bit, +-10.24 V. Both on SPI2. docs/reference/serial-board.md has the wiring.
 */
#include "config.h"
#include "port.h"
#include "stm32f405.h"

/* Pins: number on its port. */
enum { ADC_SELECT = 12, SCK = 13, MISO = 14, MOSI = 15, DAC_SELECT = 0, DAC_RESET = 1, DAC_1_SELECT = 5 }; /* B */
enum { TX = 2, RX = 3, ENCODER_0_A = 15, ENCODER_0_B = 3 };                  /* A, A, A, B */
enum { SUPPLY = 4, EMERGENCY = 5, ENCODER_1_A = 6, ENCODER_1_B = 7 };          /* C */
enum { AF_TIM2 = 1, AF_TIM3 = 2, AF_SPI2 = 5, AF_USART2 = 7 }; /* datasheet, alternate function mapping */
enum { INPUT, OUTPUT, ALTERNATE };
enum { FLOATING, PULL_UP };

#define WAITS 1000000u    /* looks at a clock that starts: 0.3 s at 16 MHz, a crystal takes 2 ms */
#define SPI_WAITS 1000u   /* looks at a byte on the bus: 50 us, it takes 0.8 */
#define FLASH_WAITS 200000000u /* a sector of 128 kB is erased in 2 s */
#define PLL_IN_HZ 2000000u /* RM0090, 7.3.2: 2 MHz limits the jitter */

/* AD5761R: address of the register in bits 19 to 16. Datasheet, input shift register. */
#define DAC_WRITE 0x30000u
#define DAC_CONTROL 0x40000u
#define DAC_READ 0xB0000u
#define DAC_NOTHING 0x00000u
/* +-10 V, own reference, off when too hot, at 0 V after a clear and at its start. */
#define DAC_SET (1u << 9 | 1u << 6 | 1u << 5 | 1u << 3)
#define MID_SCALE 0x8000u /* code of 0 V, of both converters */
#define WRONG_MOST 3u /* samples in a row at which the converter may hold something else */

/* ADS8688: datasheet, command register map. A frame gives the input that the one before has chosen. */
#define ADC_INPUT(n) (0xC000u | (uint32_t)(n) << 10)

/* The boots are counted in a sector of flash of their own, two bytes each. */
#define BOOTS 0x08060000u
#define BOOTS_SECTOR 7u
#define BOOTS_MOST 65535u
#define ERASED 0xFFFFu

static const node_config config = {
    .period_ns = 1000000000u / RATE_HZ,
    .deadman_ms = DEADMAN_MS,
    .n_output = OUTPUTS,
    .n_encoder = ENCODERS,
    .n_adc = ADCS,
    .batch = BATCH,
    .output = {{INT16_MIN, INT16_MAX, NULL_COUNTS, MAX_OUTPUT, MAX_STEP, MAX_JUMP},
               {INT16_MIN, INT16_MAX, NULL_COUNTS_1, MAX_OUTPUT_1, MAX_STEP_1, MAX_JUMP_1}},
    .firmware = "stm32f405 1",
    .serial = SERIAL,
};

static int32_t second_encoder;
static const unsigned dac_select[] = {DAC_SELECT, DAC_1_SELECT};
static unsigned wrong[OUTPUTS]; /* samples in a row, of each converter */

static int became(uint32_t address, uint32_t field, uint32_t value, uint32_t looks)
{
    while (looks-- > 0) {
        if ((reg_get(address) & field) == value) {
            return 1;
        }
    }
    return 0;
}

static void level(uint32_t port, unsigned pin, int high)
{
    reg_set(GPIO_BSRR(port), 1u << (high ? pin : pin + 16u));
}

static void pin(uint32_t port, unsigned n, uint32_t mode, uint32_t pull, uint32_t function)
{
    reg_field(GPIO_AFR(port, n), 15u << 4 * (n % 8u), function << 4 * (n % 8u));
    reg_field(GPIO_OSPEEDR(port), 3u << 2 * n, 1u << 2 * n); /* 25 MHz */
    reg_field(GPIO_PUPDR(port), 3u << 2 * n, pull << 2 * n);
    reg_field(GPIO_MODER(port), 3u << 2 * n, mode << 2 * n);
}

/* No converter takes what is on the bus. */
static void deselect(void)
{
    level(GPIOB, ADC_SELECT, 1);
    for (unsigned o = 0; o < OUTPUTS; o++) {
        level(GPIOB, dac_select[o], 1);
    }
}

/* First of all, at the 16 MHz of the reset: what must be low is driven low. */
static void start_pins(void)
{
    reg_on(RCC_AHB1ENR, RCC_AHB1ENR_GPIO_ABC);
    (void)reg_get(RCC_AHB1ENR); /* errata sheet: two cycles until it is there */
    level(GPIOC, SUPPLY, 0);
    level(GPIOB, DAC_RESET, 0);
    deselect();
    pin(GPIOC, SUPPLY, OUTPUT, FLOATING, 0);
    pin(GPIOB, DAC_RESET, OUTPUT, FLOATING, 0);
    for (unsigned o = 0; o < OUTPUTS; o++) {
        pin(GPIOB, dac_select[o], OUTPUT, FLOATING, 0);
    }
    pin(GPIOB, ADC_SELECT, OUTPUT, FLOATING, 0);
    pin(GPIOC, EMERGENCY, INPUT, PULL_UP, 0); /* a broken wire is an emergency */
    pin(GPIOB, SCK, ALTERNATE, FLOATING, AF_SPI2);
    pin(GPIOB, MISO, ALTERNATE, PULL_UP, AF_SPI2); /* no converter reads as the end of its range */
    pin(GPIOB, MOSI, ALTERNATE, FLOATING, AF_SPI2);
    pin(GPIOA, TX, ALTERNATE, FLOATING, AF_USART2);
    pin(GPIOA, RX, ALTERNATE, PULL_UP, AF_USART2);
    pin(GPIOA, ENCODER_0_A, ALTERNATE, PULL_UP, AF_TIM2);
    pin(GPIOB, ENCODER_0_B, ALTERNATE, PULL_UP, AF_TIM2);
    pin(GPIOC, ENCODER_1_A, ALTERNATE, PULL_UP, AF_TIM3);
    pin(GPIOC, ENCODER_1_B, ALTERNATE, PULL_UP, AF_TIM3);
}

/* 168 MHz from the crystal; the inner oscillator is 1 % off, too much for the sample rate. A crystal
 * that stops later is an NMI. */
static int start_clock(void)
{
    reg_on(RCC_CR, RCC_CR_HSEON | (CRYSTAL_BYPASS ? RCC_CR_HSEBYP : 0u));
    if (!became(RCC_CR, RCC_CR_HSERDY, RCC_CR_HSERDY, WAITS)) {
        return 0;
    }
    uint32_t m = CRYSTAL_HZ / PLL_IN_HZ, n = 168u, p = 2u, q = 7u; /* 2 MHz n / p = 168 MHz */
    reg_field(RCC_PLLCFGR, RCC_PLLCFGR_ALL,
              m | n << 6 | (p / 2u - 1u) << 16 | RCC_PLLCFGR_HSE | q << 24);
    reg_on(RCC_CR, RCC_CR_PLLON | RCC_CR_CSSON);
    if (!became(RCC_CR, RCC_CR_PLLRDY, RCC_CR_PLLRDY, WAITS)) {
        return 0;
    }
    reg_set(FLASH_ACR, FLASH_ACR_5WS_CACHES);
    reg_set(RCC_CFGR, RCC_CFGR_PPRE1_4 | RCC_CFGR_PPRE2_2 | RCC_CFGR_SW_PLL);
    return became(RCC_CFGR, RCC_CFGR_SWS, RCC_CFGR_SWS_PLL, WAITS);
}

/* A supply of the chip below 2.7 V ends at null, before the chip stops at 1.8 V. A Discovery has 3.0. */
static void start_supply_watch(void)
{
    reg_on(PWR_CR, PWR_CR_PLS_2V7 | PWR_CR_PVDE);
    reg_on(EXTI_RTSR, EXTI_PVD);
    reg_on(EXTI_IMR, EXTI_PVD);
    reg_set(NVIC_ISER(IRQ_PVD), NVIC_BIT(IRQ_PVD));
}

static void start_encoder(uint32_t tim, uint32_t last)
{
    reg_set(TIM_CCMR1(tim), TIM_CCMR1_INPUTS_FILTERED);
    reg_set(TIM_SMCR(tim), TIM_SMCR_ENCODER);
    reg_set(TIM_ARR(tim), last);
    reg_set(TIM_CR1(tim), TIM_CR1_CEN);
}

static void start_timers(void)
{
    start_encoder(TIM2, UINT32_MAX);
    start_encoder(TIM3, UINT16_MAX);
    reg_set(TIM_PSC(TIM5), TIMER_HZ / 1000000u - 1u); /* us */
    reg_set(TIM_ARR(TIM5), UINT32_MAX);
    reg_set(TIM_EGR(TIM5), TIM_EGR_UG);
    reg_set(TIM_CR1(TIM5), TIM_CR1_CEN);
}

/* n bits of `word`, the highest first; what came back is in `back`. Whether the bus did it. */
static int exchange(unsigned select, uint32_t word, unsigned bits, uint32_t *back)
{
    uint32_t got = 0;
    level(GPIOB, select, 0);
    for (unsigned left = bits; left > 0; left -= 8u) {
        reg_set(SPI2_DR, word >> (left - 8u) & 0xFFu);
        if (!became(SPI2_SR, SPI_SR_RXNE, SPI_SR_RXNE, SPI_WAITS)) {
            level(GPIOB, select, 1);
            return 0;
        }
        got = got << 8 | (reg_get(SPI2_DR) & 0xFFu);
    }
    int done = became(SPI2_SR, SPI_SR_BSY, 0u, SPI_WAITS);
    level(GPIOB, select, 1);
    *back = got;
    return done;
}

/* Whether an output's converter holds these counts now, by what it gives back itself. */
static int put(unsigned o, int16_t counts)
{
    uint32_t code = (uint32_t)(counts + (int32_t)MID_SCALE), back = 0;
    return exchange(dac_select[o], DAC_WRITE | code, 24u, &back) &&
           exchange(dac_select[o], DAC_READ, 24u, &back) &&
           exchange(dac_select[o], DAC_NOTHING, 24u, &back) && (back & 0xFFFFu) == code;
}

static int start_converters(void)
{
    uint32_t back;
    reg_set(SPI2_CR1, SPI_CR1_MASTER | SPI_CR1_CPHA | SPI_CR1_DIV4 | SPI_CR1_SOFT_SELECT | SPI_CR1_SPE);
    level(GPIOB, DAC_RESET, 1);
    (void)became(SPI2_SR, SPI_SR_RXNE, SPI_SR_RXNE, SPI_WAITS); /* and so wait 50 us */
    for (unsigned o = 0; o < OUTPUTS; o++) {
        if (!exchange(dac_select[o], DAC_CONTROL | DAC_SET, 24u, &back) ||
            !put(o, config.output[o].null_counts)) {
            return 0;
        }
    }
    return exchange(ADC_SELECT, ADC_INPUT(0) << 16, 32u, &back);
}

const node_config *board_start(void)
{
    start_pins();
    reg_on(RCC_APB1ENR, RCC_APB1ENR_TIM2 | RCC_APB1ENR_TIM3 | RCC_APB1ENR_TIM4 | RCC_APB1ENR_TIM5 |
                            RCC_APB1ENR_SPI2 | RCC_APB1ENR_USART2 | RCC_APB1ENR_PWR);
    watchdog_start(UINT16_MAX); /* at its longest, so that what hangs here is tried again */
    if (!start_clock()) {
        fault_handler();
    }
    start_supply_watch();
    start_timers();
    if (!start_converters()) {
        fault_handler();
    }
    return &config;
}

static void flash_open(void)
{
    reg_set(FLASH_KEYR, FLASH_KEY1);
    reg_set(FLASH_KEYR, FLASH_KEY2);
}

static void flash_done(void)
{
    (void)became(FLASH_SR, FLASH_SR_BSY, 0u, FLASH_WAITS);
    reg_set(FLASH_CR, FLASH_CR_LOCK);
}

uint16_t board_boot(void)
{
    uint32_t boots = 0;
    while (boots < BOOTS_MOST &&
           (reg_get(BOOTS + 2u * (boots & ~1u)) >> 16u * (boots & 1u) & 0xFFFFu) != ERASED) {
        boots++;
    }
    flash_open();
    if (boots == BOOTS_MOST) {
        boots = 0;
        reg_set(FLASH_CR, FLASH_CR_SER | FLASH_CR_SNB(BOOTS_SECTOR));
        reg_on(FLASH_CR, FLASH_CR_STRT);
        flash_done();
        flash_open();
    }
    reg_set(FLASH_CR, FLASH_CR_PG | FLASH_CR_X16);
    reg_set16(BOOTS + 2u * boots, 0u);
    flash_done();
    return (uint16_t)(boots + 1u);
}

uint32_t board_sense(int32_t *encoders, int16_t *adcs)
{
    uint32_t clock_us = reg_get(TIM_CNT(TIM5));
    encoders[0] = (int32_t)reg_get(TIM_CNT(TIM2));
    /* Of 16 bit: it goes the shorter way round between two samples. */
    uint32_t moved = (reg_get(TIM_CNT(TIM3)) - (uint32_t)second_encoder) & 0xFFFFu;
    second_encoder += moved < 0x8000u ? (int32_t)moved : (int32_t)moved - 0x10000;
    encoders[1] = second_encoder;
    for (unsigned i = 0; i < ADCS; i++) {
        uint32_t back = 0; /* the end of its range, if the bus hangs */
        (void)exchange(ADC_SELECT, ADC_INPUT((i + 1u) % ADCS) << 16, 32u, &back);
        adcs[i] = (int16_t)((int32_t)(back & 0xFFFFu) - (int32_t)MID_SCALE);
    }
    return clock_us;
}

int board_emergency(void)
{
    return (reg_get(GPIO_IDR(GPIOC)) & 1u << EMERGENCY) != 0;
}

void board_put(const int16_t *counts)
{
    for (unsigned o = 0; o < OUTPUTS; o++) {
        wrong[o] = put(o, counts[o]) ? 0u : wrong[o] + 1u;
        if (wrong[o] >= WRONG_MOST) {
            fault_handler();
        }
    }
}

void board_supply(int on)
{
    level(GPIOC, SUPPLY, on);
}

void board_null(void)
{
    deselect();
    /* A byte may be on its way, of whatever was interrupted. */
    (void)became(SPI2_SR, SPI_SR_BSY, 0u, SPI_WAITS);
    (void)reg_get(SPI2_DR);
    for (unsigned o = 0; o < OUTPUTS; o++) {
        if (!put(o, config.output[o].null_counts)) {
            level(GPIOB, DAC_RESET, 0); /* of all of them */
        }
    }
    level(GPIOC, SUPPLY, 0);
}
