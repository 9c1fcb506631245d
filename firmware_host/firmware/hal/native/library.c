/* The board as a shared library; its time is what the caller lets pass. */
#include <stdlib.h>
#include <string.h>

#include "board.h"

struct library {
    struct native board;
    uint8_t *records;
    size_t count;
    size_t room;
};

static void keep(void *context, const uint8_t record[NATIVE_RECORD_BYTES])
{
    struct library *l = context;
    if (l->count == l->room) {
        size_t room = l->room == 0u ? 4096u : 2u * l->room;
        uint8_t *records = realloc(l->records, room * NATIVE_RECORD_BYTES);
        if (records == NULL)
            abort();
        l->records = records;
        l->room = room;
    }
    memcpy(l->records + l->count * NATIVE_RECORD_BYTES, record, NATIVE_RECORD_BYTES);
    l->count++;
}

struct library *board_new(const uint8_t unique_id[12])
{
    struct library *l = calloc(1, sizeof *l);
    if (l == NULL)
        return NULL;
    native_init(&l->board);
    memcpy(l->board.unique_id, unique_id, sizeof l->board.unique_id);
    l->board.record = keep;
    l->board.record_context = l;
    native_reset(&l->board);
    return l;
}

void board_free(struct library *l)
{
    free(l->records);
    free(l);
}

void board_reset(struct library *l)
{
    native_reset(&l->board);
}

void board_run_us(struct library *l, uint64_t us)
{
    native_run(&l->board, l->board.now + us * (NATIVE_TICK_HZ / 1000000u));
}

void board_input(struct library *l, const uint8_t *bytes, size_t count)
{
    native_input(&l->board, bytes, count);
}

size_t board_output(struct library *l, uint8_t *bytes, size_t room)
{
    return native_output(&l->board, bytes, room);
}

size_t board_record_count(const struct library *l)
{
    return l->count;
}

/* Moves all records out; `bytes` has room for board_record_count of them. */
void board_take_records(struct library *l, uint8_t *bytes)
{
    if (l->count != 0u)
        memcpy(bytes, l->records, l->count * NATIVE_RECORD_BYTES);
    l->count = 0u;
}

void board_set_health(struct library *l, int16_t temperature_dc, uint8_t faults, uint8_t open_led)
{
    l->board.health = (struct evlcp_health){.temperature_dc = temperature_dc, .faults = faults};
    if (open_led < EVLCP_LEDS)
        l->board.health.open_leds[open_led / 8u] = (uint8_t)(0x80u >> open_led % 8u);
}

void board_set_late(struct library *l, uint32_t ticks)
{
    l->board.late = ticks;
}

void board_set_failures(struct library *l, uint8_t level, uint8_t flash)
{
    l->board.level_fails = level != 0u;
    l->board.flash_fails = flash != 0u;
}

void board_shown(const struct library *l, uint8_t row[EVLCP_ROW_BYTES])
{
    memcpy(row, l->board.shown, EVLCP_ROW_BYTES);
}

uint16_t board_level(const struct library *l)
{
    return l->board.level_ma;
}

uint8_t board_running(const struct library *l)
{
    return l->board.running;
}

/* The flash does so many words and erases more, the last one by half; 0: all of them. */
void board_cut_power(struct library *l, uint32_t left)
{
    l->board.power_left = left;
    l->board.power_fails = false;
}

/* What stands in the place of an image, EVLCP_IMAGE_SLOT_BYTES. */
void board_image(const struct library *l, uint8_t image, uint8_t *bytes)
{
    memcpy(bytes, l->board.images[image - 1u], EVLCP_IMAGE_SLOT_BYTES);
}

/* Pulses from tick `next` on, a period in ticks; 0: none. */
void board_set_pulse(struct library *l, double period, double next)
{
    l->board.pulse_period = period;
    l->board.pulse_next = next;
}

size_t board_flash_bytes(void)
{
    return sizeof((struct native *)0)->flash;
}

void board_flash(const struct library *l, uint8_t *bytes)
{
    memcpy(bytes, l->board.flash, sizeof l->board.flash);
}

/* The flash of another board, and a reset. */
void board_set_flash(struct library *l, const uint8_t *bytes)
{
    memcpy(l->board.flash, bytes, sizeof l->board.flash);
    native_reset(&l->board);
}
