/* Registers of the STM32F405/407/415/417 that the node uses: addresses and bits of ST's reference
 * manual RM0090, core registers of ARM's ARMv7-M manual. Every access goes through reg_get and
 * reg_set, so that a test on another machine can stand where the chip would.
 */
#ifndef SAMII_RIG_STM32F405_H
#define SAMII_RIG_STM32F405_H

#include <stdint.h>

#ifdef NODE_BOARD_TEST
uint32_t reg_get(uint32_t address);
void reg_set(uint32_t address, uint32_t value);
void reg_set16(uint32_t address, uint16_t value);
void wait_for_interrupt(void);
#else
static inline uint32_t reg_get(uint32_t address)
{
    return *(volatile uint32_t *)address;
}

static inline void reg_set(uint32_t address, uint32_t value)
{
    *(volatile uint32_t *)address = value;
}

static inline void reg_set16(uint32_t address, uint16_t value)
{
    *(volatile uint16_t *)address = value;
}

static inline void wait_for_interrupt(void)
{
    __asm volatile("wfi" ::: "memory");
}
#endif

/* Set the bits of `field` to `value`, which stands where the field does. */
static inline void reg_field(uint32_t address, uint32_t field, uint32_t value)
{
    reg_set(address, (reg_get(address) & ~field) | value);
}

static inline void reg_on(uint32_t address, uint32_t bits)
{
    reg_field(address, bits, bits);
}

/* Clocks: RM0090, 7.3 */
#define RCC_CR 0x40023800u
#define RCC_CR_HSEON (1u << 16)
#define RCC_CR_HSERDY (1u << 17)
#define RCC_CR_HSEBYP (1u << 18)
#define RCC_CR_CSSON (1u << 19)
#define RCC_CR_PLLON (1u << 24)
#define RCC_CR_PLLRDY (1u << 25)
#define RCC_PLLCFGR 0x40023804u
#define RCC_PLLCFGR_HSE (1u << 22)
#define RCC_PLLCFGR_ALL 0x0F437FFFu /* what is reserved stays */
#define RCC_CFGR 0x40023808u
#define RCC_CFGR_SW_PLL 2u
#define RCC_CFGR_SWS (3u << 2)
#define RCC_CFGR_SWS_PLL (2u << 2)
#define RCC_CFGR_PPRE1_4 (5u << 10)
#define RCC_CFGR_PPRE2_2 (4u << 13)
#define RCC_AHB1ENR 0x40023830u
#define RCC_AHB1ENR_GPIO_ABC 7u
#define RCC_APB1ENR 0x40023840u
#define RCC_APB1ENR_TIM2 (1u << 0)
#define RCC_APB1ENR_TIM3 (1u << 1)
#define RCC_APB1ENR_TIM4 (1u << 2)
#define RCC_APB1ENR_TIM5 (1u << 3)
#define RCC_APB1ENR_SPI2 (1u << 14)
#define RCC_APB1ENR_USART2 (1u << 17)
#define RCC_APB1ENR_PWR (1u << 28)

/* Flash: 3.9 */
#define FLASH_ACR 0x40023C00u
#define FLASH_ACR_5WS_CACHES (5u | 7u << 8)
#define FLASH_KEYR 0x40023C04u
#define FLASH_KEY1 0x45670123u
#define FLASH_KEY2 0xCDEF89ABu
#define FLASH_SR 0x40023C0Cu
#define FLASH_SR_BSY (1u << 16)
#define FLASH_CR 0x40023C10u
#define FLASH_CR_PG (1u << 0)
#define FLASH_CR_SER (1u << 1)
#define FLASH_CR_SNB(n) ((uint32_t)(n) << 3)
#define FLASH_CR_X16 (1u << 8)
#define FLASH_CR_STRT (1u << 16)
#define FLASH_CR_LOCK (1u << 31)

/* Supply voltage: 5.4; interrupt lines: 12.3 */
#define PWR_CR 0x40007000u
#define PWR_CR_PVDE (1u << 4)
#define PWR_CR_PLS_2V7 (5u << 5)
#define EXTI_IMR 0x40013C00u
#define EXTI_RTSR 0x40013C08u
#define EXTI_PR 0x40013C14u
#define EXTI_PVD (1u << 16)

/* Pins: 8.4 */
#define GPIOA 0x40020000u
#define GPIOB 0x40020400u
#define GPIOC 0x40020800u
#define GPIO_MODER(port) ((port) + 0x00u)
#define GPIO_OSPEEDR(port) ((port) + 0x08u)
#define GPIO_PUPDR(port) ((port) + 0x0Cu)
#define GPIO_IDR(port) ((port) + 0x10u)
#define GPIO_BSRR(port) ((port) + 0x18u)
#define GPIO_AFR(port, pin) ((port) + 0x20u + 4u * ((pin) / 8u))

/* Timers: 18.4 */
#define TIM2 0x40000000u
#define TIM3 0x40000400u
#define TIM4 0x40000800u
#define TIM5 0x40000C00u
#define TIM_CR1(tim) ((tim) + 0x00u)
#define TIM_CR1_CEN 1u
#define TIM_SMCR(tim) ((tim) + 0x08u)
#define TIM_SMCR_ENCODER 3u
#define TIM_DIER(tim) ((tim) + 0x0Cu)
#define TIM_DIER_UIE 1u
#define TIM_SR(tim) ((tim) + 0x10u)
#define TIM_EGR(tim) ((tim) + 0x14u)
#define TIM_EGR_UG 1u
#define TIM_CCMR1(tim) ((tim) + 0x18u)
#define TIM_CCMR1_INPUTS_FILTERED (1u | 3u << 4 | 1u << 8 | 3u << 12)
#define TIM_CNT(tim) ((tim) + 0x24u)
#define TIM_PSC(tim) ((tim) + 0x28u)
#define TIM_ARR(tim) ((tim) + 0x2Cu)

/* Serial port: 30.6 */
#define USART2_SR 0x40004400u
#define USART_SR_RXNE (1u << 5)
#define USART_SR_TXE (1u << 7)
#define USART2_DR 0x40004404u
#define USART2_BRR 0x40004408u
#define USART2_CR1 0x4000440Cu
#define USART_CR1_RE (1u << 2)
#define USART_CR1_TE (1u << 3)
#define USART_CR1_RXNEIE (1u << 5)
#define USART_CR1_TXEIE (1u << 7)
#define USART_CR1_UE (1u << 13)

/* Converters' bus: 28.5 */
#define SPI2_CR1 0x40003800u
#define SPI_CR1_CPHA (1u << 0)
#define SPI_CR1_MASTER (1u << 2)
#define SPI_CR1_DIV4 (1u << 3)
#define SPI_CR1_SPE (1u << 6)
#define SPI_CR1_SOFT_SELECT (3u << 8)
#define SPI2_SR 0x40003808u
#define SPI_SR_RXNE (1u << 0)
#define SPI_SR_BSY (1u << 7)
#define SPI2_DR 0x4000380Cu

/* Independent watchdog: 21.4 */
#define IWDG_KR 0x40003000u
#define IWDG_KR_FEED 0xAAAAu
#define IWDG_KR_WRITE 0x5555u
#define IWDG_KR_START 0xCCCCu
#define IWDG_PR 0x40003004u
#define IWDG_PR_4 0u
#define IWDG_PR_256 6u
#define IWDG_RLR 0x40003008u
#define IWDG_SR 0x4000300Cu

/* Core: ARMv7-M B3.4 and B3.2 */
#define NVIC_ISER(irq) (0xE000E100u + 4u * ((irq) / 32u))
#define NVIC_ISPR(irq) (0xE000E200u + 4u * ((irq) / 32u))
#define NVIC_BIT(irq) (1u << ((irq) % 32u))
#define NVIC_IPR(irq) (0xE000E400u + ((irq) & ~3u))
#define IRQ_PVD 1u
#define IRQ_TIM4 30u
#define IRQ_USART2 38u
#define SCB_VTOR 0xE000ED08u
#define SCB_AIRCR 0xE000ED0Cu
#define SCB_AIRCR_RESET 0x05FA0004u

#endif
