#include "player.h"

#include "hal.h"

static const uint8_t dark[EVLCP_ROW_BYTES];

/* Go to packet `next` of the active bank, or to what its stream has next. */
static void seek(struct evlcp_player *player, struct evlcp_banks *banks, uint32_t next)
{
    uint8_t bank = atomic_load(&banks->active);
    const struct evlcp_plan *plan = &banks->plan[bank];
    if (!player->idle)
        player->idle_dark = 0u;
    player->idle = atomic_load(&player->want_idle);
    player->idle_left = plan->packet_chips;
    player->lit = plan->lit;
    if (next >= plan->packets)
        next = 0u;
    if (banks->stream[bank].on) {
        player->idle_left = EVLCP_STREAM_IDLE_CHIPS;
        switch (evlcp_stream_take(&banks->stream[bank], player->idle, &next)) {
        case EVLCP_STREAM_END:
            atomic_store(&player->want_play, false);
            player->halt = true;
            return;
        case EVLCP_STREAM_IDLE:
            player->idle = true;
            return;
        default:
            break;
        }
    }
    evlcp_cursor_seek(&player->cursor, plan, banks->content[bank], next);
}

/* Row of the next chip. */
static void compose(struct evlcp_player *player)
{
    if (player->idle) {
        /* One chip of two, or of more where the limits of light ask for it. */
        uint32_t duty = atomic_load(&player->guard.duty);
        uint32_t most = duty >= 500u ? 1u : duty != 0u ? (1000u + duty - 1u) / duty - 1u : UINT32_MAX;
        bool on = player->idle_dark >= most;
        player->idle_dark = on ? 0u : player->idle_dark + 1u;
        evlcp_copy(player->row, on ? player->lit : dark, EVLCP_ROW_BYTES);
        player->packet_done = --player->idle_left == 0u;
    } else {
        player->packet_done = evlcp_cursor_row(&player->cursor, player->row);
    }
    /* The last thing between what is played and the LEDs. */
    if (!evlcp_guard_check_row(&player->guard, player->row)) {
        atomic_store(&player->over_limit, true);
        player->halt = true;
    }
}

/* What follows a packet: the pending bank's first, the next of the active bank, the idle pattern, or dark. */
static void next_packet(struct evlcp_player *player, struct evlcp_banks *banks)
{
    /* During the idle pattern the cursor stands at the packet that comes after it. */
    uint32_t next = player->idle ? player->cursor.packet : player->cursor.packet + 1u;
    if (evlcp_banks_swap(banks))
        next = 0u;
    if (!atomic_load(&player->want_play)) {
        player->halt = true;
        return;
    }
    seek(player, banks, next);
}

void evlcp_player_begin(struct evlcp_player *player, struct evlcp_banks *banks)
{
    const struct evlcp_plan *plan = &banks->plan[atomic_load(&banks->active)];
    player->chip = 0u;
    player->halt = false;
    player->ticks_per_chip = plan->setup.ticks_per_chip;
    atomic_store(&player->chip_lost, false);
    atomic_store(&player->over_limit, false);
    atomic_store(&player->lateness, 0u);
    atomic_store(&player->lateness_max, 0u);
    uint32_t rested_ms = hal_millis() - player->dark_ms;
    if (rested_ms > 1000u)
        rested_ms = 1000u; /* longer than any burst */
    evlcp_guard_add_dark(&player->guard, rested_ms * plan->setup.chip_rate_hz / 1000u);
    seek(player, banks, 0u);
    if (player->halt)
        return; /* the end of a stream that has played */
    compose(player);
    player->rests = false;
    atomic_store(&player->running, true);
    hal_set_chip_clock(plan->setup.ticks_per_chip);
}

void evlcp_player_blank(struct evlcp_player *player)
{
    hal_set_chip_clock(0u);
    hal_show_leds(dark, EVLCP_CHIP_DARK);
    atomic_store(&player->running, false);
}

void evlcp_player_chip(struct evlcp_player *player, struct evlcp_banks *banks)
{
    if (player->halt) {
        evlcp_player_blank(player);
        return;
    }
    /* First the output, so that its delay does not depend on what follows. */
    hal_show_leds(player->row, player->chip);
    uint32_t late = hal_lateness();
    atomic_store(&player->lateness, late);
    if (late > atomic_load(&player->lateness_max))
        atomic_store(&player->lateness_max, late);
    if (late >= player->ticks_per_chip) {
        atomic_store(&player->chip_lost, true);
        evlcp_player_blank(player);
        return;
    }
    atomic_store(&player->chips_sent, atomic_load(&player->chips_sent) + 1u);
    /* The two topmost numbers have a meaning of their own. */
    player->chip = player->chip + 1u == EVLCP_CHIP_TEST ? 0u : player->chip + 1u;
    if (player->packet_done) {
        if (!player->idle)
            atomic_store(&player->packets_sent, atomic_load(&player->packets_sent) + 1u);
        next_packet(player, banks);
        if (player->halt)
            return;
    }
    compose(player);
}
