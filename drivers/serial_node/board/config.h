/* What this node is: numbers of one rig, set where the image is made (make RATE_HZ=1000 ...).
 * They are hard: the host can ask for less only.
 */
#ifndef SAMII_RIG_CONFIG_H
#define SAMII_RIG_CONFIG_H

#ifndef CRYSTAL_HZ
#define CRYSTAL_HZ 8000000u /* STM32F4-Discovery, Olimex STM32-H405; a whole number of 2 MHz */
#endif
#ifndef CRYSTAL_BYPASS
#define CRYSTAL_BYPASS 0 /* 1 where a clock comes in from outside, as on a Nucleo */
#endif
#ifndef RATE_HZ
#define RATE_HZ 500u /* rate_hz of the rig file; 1000000/RATE_HZ is a whole number of us */
#endif
#ifndef DEADMAN_MS
#define DEADMAN_MS 50u /* deadman of the rig file's actuator */
#endif
#ifndef NULL_COUNTS
#define NULL_COUNTS 0 /* counts at which the valve stands still: samii-rig calibrate null */
#endif
#ifndef MAX_OUTPUT
#define MAX_OUTPUT 32767u /* counts from the null; 3276.8 counts are 1 V */
#endif
#ifndef MAX_STEP
#define MAX_STEP 32767u /* counts in one sample */
#endif
#ifndef MAX_JUMP
#define MAX_JUMP 1304 /* encoder counts in one sample: 0.05 rad of 163840 a turn */
#endif
#ifndef OUTPUTS
#define OUTPUTS 1u /* 1 or 2 */
#endif
/* Of the second output. */
#ifndef NULL_COUNTS_1
#define NULL_COUNTS_1 0
#endif
#ifndef MAX_OUTPUT_1
#define MAX_OUTPUT_1 MAX_OUTPUT
#endif
#ifndef MAX_STEP_1
#define MAX_STEP_1 MAX_STEP
#endif
#ifndef MAX_JUMP_1
#define MAX_JUMP_1 MAX_JUMP
#endif
#ifndef ENCODERS
#define ENCODERS 2u /* 1 or 2 */
#endif
#ifndef ADCS
#define ADCS 8u /* 1 to 8 */
#endif
#ifndef BATCH
#define BATCH 4u /* samples in a frame; together at most 10 ms */
#endif
#ifndef SERIAL
#define SERIAL "BOARD-0001" /* at most 16 characters */
#endif

_Static_assert(CRYSTAL_HZ % 2000000u == 0, "CRYSTAL_HZ: a whole number of 2 MHz");
_Static_assert(RATE_HZ >= 20 && 1000000u % RATE_HZ == 0, "RATE_HZ: at least 20, a whole number of us a sample");
_Static_assert(DEADMAN_MS * 17u * RATE_HZ > 2u * 47000u, "DEADMAN_MS: at least six samples, for the watchdog's clock");
_Static_assert(NULL_COUNTS >= -32768 && NULL_COUNTS <= 32767, "NULL_COUNTS: of 16 bit");
_Static_assert(MAX_OUTPUT <= 65535u && MAX_STEP <= 65535u, "MAX_OUTPUT, MAX_STEP: of 16 bit");
_Static_assert(MAX_JUMP >= 0, "MAX_JUMP: at least 0");
_Static_assert(OUTPUTS >= 1 && OUTPUTS <= 2, "OUTPUTS: 1 or 2");
_Static_assert(NULL_COUNTS_1 >= -32768 && NULL_COUNTS_1 <= 32767, "NULL_COUNTS_1: of 16 bit");
_Static_assert(MAX_OUTPUT_1 <= 65535u && MAX_STEP_1 <= 65535u, "MAX_OUTPUT_1, MAX_STEP_1: of 16 bit");
_Static_assert(MAX_JUMP_1 >= 0, "MAX_JUMP_1: at least 0");
_Static_assert(ENCODERS >= 1 && ENCODERS <= 2, "ENCODERS: 1 or 2");
_Static_assert(ADCS >= 1 && ADCS <= 8, "ADCS: 1 to 8");
_Static_assert(BATCH >= 1 && BATCH <= 8 && BATCH * 100u <= RATE_HZ, "BATCH: 1 to 8 samples, at most 10 ms");
_Static_assert(sizeof SERIAL <= 17, "SERIAL: at most 16 characters");

#endif
