/* In place of the chip's own file where the emulator has no clocks, pins, converters, encoders,
 * flash: the rig is a program on the other side of two pipes. Everything else is the same image.
 *
 * The board writes what it put out and how much it sent, then waits for the inputs of the next
 * sample: the program paces, and how fast the emulator is does not matter.
 */
#include "port.h"
#include "stm32f405.h"

enum { SYS_OPEN = 1, SYS_WRITE = 5, SYS_READ = 6, SYS_GET_CMDLINE = 0x15, SYS_EXIT = 0x18 };
enum { READ_BINARY = 1, WRITE_BINARY = 5, APPLICATION_EXIT = 0x20026 };
enum { NOTHING, RESET, HANG, FAULT, SUPPLY_DROPS, STACK }; /* what to do, of the rig */

typedef struct {
    uint32_t clock_us;
    uint32_t came; /* bytes that were sent to the board so far: they come before this sample */
    int32_t encoders[NODE_MAX_ENCODERS];
    int16_t adcs[NODE_MAX_ADCS];
    uint8_t emergency, what, unused[2];
} inputs;

typedef struct {
    uint32_t went; /* bytes that the board has sent */
    uint32_t samples;
    int16_t counts[NODE_MAX_OUTPUTS];
    uint16_t boot;
    uint8_t supply, handler, unused[2]; /* handler : of what is wrong, has put this out */
} outputs;

/* What lasts over a reset: it is no part of what the start clears. */
static __attribute__((section(".kept"))) struct {
    uint32_t magic;
    int32_t from_rig, to_rig;
    uint16_t boot;
} kept;
#define MAGIC 0x4E4F4445u

static struct {
    node_config config;
    uint32_t sample; /* number of the first */
    uint16_t boot, unused; /* 0 : one more than before */
} told;
static inputs in;
static outputs out;

static int32_t host(uint32_t what, const void *arguments)
{
    register uint32_t r0 __asm("r0") = what;
    register const void *r1 __asm("r1") = arguments;
    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return (int32_t)r0;
}

static void tell(void)
{
    uint32_t arguments[] = {(uint32_t)kept.to_rig, (uint32_t)&out, sizeof out};
    out.went = wire_went();
    (void)host(SYS_WRITE, arguments);
}

static void ask(void *into, uint32_t n)
{
    uint32_t arguments[] = {(uint32_t)kept.from_rig, (uint32_t)into, n};
    if (host(SYS_READ, arguments) != 0) {
        (void)host(SYS_EXIT, (const void *)APPLICATION_EXIT); /* the rig's program has ended */
    }
}

static int32_t opened(const char *path, uint32_t mode)
{
    uint32_t n = 0;
    while (path[n] != 0) {
        n++;
    }
    uint32_t arguments[] = {(uint32_t)path, mode, n};
    return host(SYS_OPEN, arguments);
}

static void put_nulls(void)
{
    for (unsigned o = 0; o < told.config.n_output; o++) {
        out.counts[o] = told.config.output[o].null_counts;
    }
}

const node_config *board_start(void)
{
    if (kept.magic != MAGIC) {
        static char line[256]; /* "FROM_RIG TO_RIG" */
        uint32_t arguments[] = {(uint32_t)line, sizeof line}, gap = 0;
        (void)host(SYS_GET_CMDLINE, arguments);
        while (line[gap] != ' ') {
            gap++;
        }
        line[gap] = 0;
        kept.from_rig = opened(line, READ_BINARY);
        kept.to_rig = opened(line + gap + 1, WRITE_BINARY);
        kept.boot = 0;
        kept.magic = MAGIC;
    }
    ask(&told, sizeof told);
    put_nulls();
    reg_set(NVIC_ISER(IRQ_PVD), NVIC_BIT(IRQ_PVD));
    return &told.config;
}

/* The next sample, once this one has ended: QEMU 7.2 reloads its timers wrongly. */
static void tick(void)
{
    reg_set(NVIC_ISPR(IRQ_TIM4), NVIC_BIT(IRQ_TIM4));
}

uint16_t board_boot(void)
{
    tick();
    kept.boot = told.boot != 0 ? told.boot : (uint16_t)(kept.boot + 1u);
    out.boot = kept.boot;
    return kept.boot;
}

static void do_wrong(uint8_t what)
{
    static volatile uint32_t *const nowhere = (uint32_t *)0x60000000u;
    switch (what) {
    case RESET:
        reg_set(SCB_AIRCR, SCB_AIRCR_RESET);
        for (;;) {
        }
    case HANG:
        for (;;) {
        }
    case FAULT:
        *nowhere = 0;
        break;
    case SUPPLY_DROPS:
        reg_set(NVIC_ISPR(IRQ_PVD), NVIC_BIT(IRQ_PVD));
        break;
    case STACK:
        __asm volatile("ldr sp, =0x20000010\n push {r0-r7}\n push {r0-r7}\n");
        break;
    default:
        break;
    }
}

uint32_t board_sense(int32_t *encoders, int16_t *adcs)
{
    if (out.samples == 0) {
        node.sample = told.sample;
    }
    tell();
    ask(&in, sizeof in);
    __asm volatile("cpsid i");
    while (wire_came() != in.came) {
        __asm volatile("wfi\n cpsie i\n isb\n cpsid i" ::: "memory");
    }
    __asm volatile("cpsie i" ::: "memory");
    do_wrong(in.what);
    node_receive();
    for (unsigned i = 0; i < NODE_MAX_ENCODERS; i++) {
        encoders[i] = in.encoders[i];
    }
    for (unsigned i = 0; i < NODE_MAX_ADCS; i++) {
        adcs[i] = in.adcs[i];
    }
    out.samples++;
    return in.clock_us;
}

int board_emergency(void)
{
    return in.emergency;
}

void board_put(const int16_t *counts)
{
    for (unsigned o = 0; o < told.config.n_output; o++) {
        out.counts[o] = counts[o];
    }
}

void board_supply(int on)
{
    out.supply = (uint8_t)(on != 0);
    tick();
}

void board_null(void)
{
    put_nulls();
    out.supply = 0;
    out.handler = 1;
    tell();
}
