/* The driver board in a process: HAL over memory and a virtual tick counter. A shared library; time moves
   only in board_run_us, so the caller decides when chips fall due. */
#ifndef EVLCP_NATIVE_BOARD_H
#define EVLCP_NATIVE_BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "evlcp.h"

#define NATIVE_TICK_HZ 10000000u
#define NATIVE_RECORD_BYTES 20u

/* What the process around it reads and turns: first in the board, and the same as `Bench` of the Python side. */
struct native_bench {
    uint8_t *output; /* sent, not yet collected */
    size_t output_length;
    uint8_t *records; /* of LEDs, not yet collected: u32 tick, u32 chip, row; little-endian */
    size_t record_count;
    uint8_t *flash; /* the slots of SAVE */
    size_t flash_bytes;
    uint8_t *images[EVLCP_IMAGES];
    double pulse_period; /* of the pulse input, ticks; 0: none */
    double pulse_next;
    uint32_t late;       /* what hal_lateness says, to test a chip that comes late */
    uint32_t power_left; /* words and erases of the flash until its power fails, the last one by half; 0: for ever */
    bool power_fails;    /* the flash takes no more */
    bool level_fails;
    bool flash_fails;
    uint8_t running; /* image: 0, 1, 2 */
    uint16_t level_ma;
    uint8_t shown[EVLCP_ROW_BYTES];
    struct evlcp_health health;
};

struct native {
    struct native_bench bench;
    struct evlcp core;
    uint64_t now;       /* ticks since it was made */
    uint64_t reset_at;  /* ticks at the last reset */
    uint64_t due;       /* next chip */
    uint32_t period;    /* ticks a chip; 0: no chips */
    uint8_t unique_id[12];
    uint8_t flash[EVLCP_SLOTS][EVLCP_SLOT_BYTES];
    uint8_t images[EVLCP_IMAGES][EVLCP_IMAGE_SLOT_BYTES];
    struct evlcp_pulse pulse;
    struct evlcp_when when;
    bool waits;       /* the next chips begin at `when` */
    bool in_step;
    uint64_t chips;   /* since the start in step */
    uint64_t begun;   /* tick of it */
    bool restart;
    uint8_t output[1u << 16];
    size_t record_room;
};

/* Power on: empty flash; NULL without memory. */
struct native *board_new(const uint8_t unique_id[12]);
void board_free(struct native *board);

/* Reset: all but the flash is lost. */
void board_reset(struct native *board);

/* Let time go on: chips fall due, requests are answered between them. */
void board_run_us(struct native *board, uint64_t us);

/* Bytes arrive. */
void board_input(struct native *board, const uint8_t *bytes, size_t count);

#endif
