/* Plays the active bank chip by chip; swaps banks only between packets. */
#pragma once

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "banks.h"
#include "guard.h"

/* The main loop writes `want_play` and `want_idle`; the chip interrupt writes the rest while `running`, the main
   loop while not. */
struct evlcp_player {
    atomic_bool want_play; /* false: stop after the packet */
    atomic_bool want_idle; /* idle pattern from the next packet boundary on */
    atomic_bool running;
    atomic_bool chip_lost; /* stopped because a chip came a whole chip late */
    atomic_bool over_limit; /* stopped because the guard refused a row */
    bool idle;             /* this packet is the idle pattern */
    bool packet_done;      /* `row` is the packet's last */
    bool halt;             /* the row on show is the last */
    struct evlcp_cursor cursor;
    const uint8_t *lit; /* LEDs of the idle pattern */
    uint32_t idle_dark; /* chips since they were lit, or since it began */
    uint32_t idle_left;
    uint32_t chip;
    uint32_t ticks_per_chip;
    bool rests; /* the main loop has seen that it does not run */
    uint32_t dark_ms; /* since when */
    struct evlcp_guard guard;
    uint8_t row[EVLCP_ROW_BYTES];
    atomic_uint_least32_t packets_sent;
    atomic_uint_least32_t chips_sent;
    atomic_uint_least32_t lateness;
    atomic_uint_least32_t lateness_max;
};

/* Start with the active bank's first packet; must not run, and a bank must be active. */
void evlcp_player_begin(struct evlcp_player *player, struct evlcp_banks *banks);

/* Dark at once. */
void evlcp_player_blank(struct evlcp_player *player);

/* One chip: called by the HAL's chip interrupt. */
void evlcp_player_chip(struct evlcp_player *player, struct evlcp_banks *banks);
