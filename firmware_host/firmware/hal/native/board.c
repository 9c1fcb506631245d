/* The driver board in a process: HAL over memory and a virtual tick counter. A shared library; time moves
   only in board_run_us, so the caller decides when chips fall due. */
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>

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
    bool restart;
    uint8_t output[1u << 16];
    size_t record_room;
};

/* The HAL has no context argument, as on a board; here it is the board that runs on this thread. */
static _Thread_local struct native *self;

void hal_get_info(struct evlcp_hal_info *info)
{
    *info = (struct evlcp_hal_info){
        .tick_hz = NATIVE_TICK_HZ,
        .ticks_per_chip_max = 0xffffffffu,
        .chip_rate_max_hz = 20000u,
        .level_max_ma = 60u,
        .level_default_ma = 20u,
        .mean_max_ma = 30u,
        .burst_chips = 64u,
        .capabilities = EVLCP_CAPABILITY_FLASH | EVLCP_CAPABILITY_LEVEL | EVLCP_CAPABILITY_RECORDS | EVLCP_CAPABILITY_PULSE | EVLCP_CAPABILITY_UPDATE,
        .clock_hz = NATIVE_TICK_HZ,
        .name = "native",
        .target = "native"};
    memcpy(info->unique_id, self->unique_id, sizeof info->unique_id);
}

void hal_show_leds(const uint8_t *row, uint32_t chip)
{
    memcpy(self->bench.shown, row, EVLCP_ROW_BYTES);
    if (self->bench.record_count == self->record_room) {
        self->record_room = self->record_room == 0u ? 4096u : 2u * self->record_room;
        self->bench.records = realloc(self->bench.records, self->record_room * NATIVE_RECORD_BYTES);
        if (self->bench.records == NULL)
            abort();
    }
    uint8_t *record = self->bench.records + self->bench.record_count++ * NATIVE_RECORD_BYTES;
    evlcp_put32(record, (uint32_t)self->now);
    evlcp_put32(record + 4, chip);
    memcpy(record + 8, row, EVLCP_ROW_BYTES);
}

void hal_set_chip_clock(uint32_t ticks)
{
    self->period = ticks;
    self->due = self->now + ticks;
    self->in_step = false;
    if (ticks == 0u || !self->waits)
        return;
    self->waits = false;
    self->in_step = self->when.pulse != 0u;
    self->chips = 0u;
    self->due = self->now + (uint64_t)(int64_t)(int32_t)(self->when.at - (uint32_t)self->now) + ticks;
}

void hal_schedule_start(const struct evlcp_when *when)
{
    self->when = *when;
    self->waits = true;
}

uint32_t hal_clock(void)
{
    return (uint32_t)self->now;
}

bool hal_read_pulse(struct evlcp_pulse *pulse)
{
    *pulse = self->pulse;
    return !self->in_step || (uint32_t)self->now - self->pulse.at < self->pulse.between / 2u * 3u;
}

static void pulses(struct native *board)
{
    while (board->bench.pulse_period > 0.0 && (double)board->now >= board->bench.pulse_next) {
        uint32_t at = (uint32_t)(uint64_t)board->bench.pulse_next;
        board->pulse.between = board->pulse.count != 0u ? at - board->pulse.at : 0u;
        board->pulse.at = at;
        board->pulse.count++;
        board->bench.pulse_next += board->bench.pulse_period;
    }
}

/* In step, the next chip is due by the pulses: a chip is a share of the time between them. */
static uint64_t next_due(struct native *board)
{
    if (!board->in_step)
        return board->due + board->period;
    double chip = (double)board->pulse.between * board->when.pulse_hz / board->when.chip_rate_hz;
    double since = (double)(int32_t)(board->pulse.count - board->when.pulse) * board->when.chip_rate_hz / board->when.pulse_hz;
    board->chips++;
    return (uint64_t)((double)board->pulse.at + ((double)board->chips + 1.0 - since) * chip + 0.5);
}

uint32_t hal_lateness(void)
{
    return self->bench.late;
}

uint32_t hal_millis(void)
{
    return (uint32_t)((self->now - self->reset_at) / (NATIVE_TICK_HZ / 1000u));
}

uint32_t hal_send(const uint8_t *bytes, uint32_t count)
{
    size_t room = sizeof self->output - self->bench.output_length;
    if (count > room)
        count = (uint32_t)room;
    memcpy(self->output + self->bench.output_length, bytes, count);
    self->bench.output_length += count;
    return count;
}

bool hal_random(uint8_t *bytes, uint32_t count)
{
    return getrandom(bytes, count, 0) == (ssize_t)count;
}

uint32_t hal_lost_bytes(void)
{
    return 0u;
}

bool hal_set_level(uint16_t level_ma)
{
    if (!self->bench.level_fails)
        self->bench.level_ma = level_ma;
    return !self->bench.level_fails;
}

void hal_read_health(struct evlcp_health *health)
{
    *health = self->bench.health;
}

#define WAIT_TICKS (NATIVE_TICK_HZ / 2000u)

static uint8_t *slot_of(uint8_t slot, uint32_t *size)
{
    *size = slot < EVLCP_SLOTS ? EVLCP_SLOT_BYTES : EVLCP_IMAGE_SLOT_BYTES;
    return slot < EVLCP_SLOTS ? self->flash[slot] : self->images[slot - EVLCP_SLOTS];
}

/* Whether the flash still has power; the last operation that it has power for is cut short. */
static bool powered(bool *cut)
{
    *cut = false;
    if (self->bench.power_left == 0u)
        return !self->bench.power_fails;
    if (--self->bench.power_left == 0u) {
        self->bench.power_fails = true;
        *cut = true;
    }
    return true;
}

bool hal_flash_erase(uint8_t slot)
{
    uint32_t size;
    bool cut;
    uint8_t *bytes = slot_of(slot, &size);
    if (!powered(&cut))
        return false;
    /* An erase that is cut short leaves some of the old bits. */
    for (uint32_t i = 0; i < size; i++)
        bytes[i] = cut && i % 3u != 0u ? bytes[i] | 0x5au : 0xffu;
    return !self->bench.flash_fails && !cut;
}

bool hal_flash_write(uint8_t slot, uint32_t offset, const uint8_t *bytes, uint32_t count)
{
    /* Like NOR flash: bits only go from one to zero until the next erase; word by word. */
    uint32_t size;
    bool cut = false;
    uint8_t *to = slot_of(slot, &size);
    for (uint32_t i = 0; i < count; i++) {
        if (i % 4u == 0u && (cut || !powered(&cut)))
            return false;
        to[offset + i] &= cut ? bytes[i] | 0xa5u : bytes[i];
    }
    return !self->bench.flash_fails && !cut;
}

void hal_flash_read(uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t count)
{
    uint32_t size;
    memcpy(bytes, slot_of(slot, &size) + offset, count);
}

uint8_t hal_running_image(void)
{
    return self->bench.running;
}

void hal_restart(void)
{
    self->restart = true;
}

/* Reset: all but the flash is lost. */
void board_reset(struct native *board)
{
    self = board;
    board->reset_at = board->now;
    board->period = 0u;
    board->bench.late = 0u;
    board->bench.output_length = 0u;
    board->restart = false;
    board->pulse = (struct evlcp_pulse){.count = 0u};
    board->waits = false;
    board->in_step = false;
    memset(&board->core, 0, sizeof board->core);
    board->bench.running = evlcp_update_pick_image();
    evlcp_init(&board->core);
}

/* Power on: empty flash; NULL without memory. */
struct native *board_new(const uint8_t unique_id[12])
{
    struct native *board = calloc(1, sizeof *board);
    if (board == NULL)
        return NULL;
    memset(board->flash, 0xff, sizeof board->flash);
    memset(board->images, 0xff, sizeof board->images);
    board->bench.output = board->output;
    board->bench.flash = board->flash[0];
    board->bench.flash_bytes = sizeof board->flash;
    for (uint32_t i = 0; i < EVLCP_IMAGES; i++)
        board->bench.images[i] = board->images[i];
    memcpy(board->unique_id, unique_id, sizeof board->unique_id);
    board->bench.health.temperature_dc = 250;
    board_reset(board);
    return board;
}

void board_free(struct native *board)
{
    free(board->bench.records);
    free(board);
}

static void serve(struct native *board)
{
    uint32_t before;
    do {
        before = board->core.requests;
        evlcp_poll(&board->core);
    } while (board->core.requests != before);
    if (board->restart)
        board_reset(board);
}

/* Let time go on: chips fall due, requests are answered between them. */
void board_run_us(struct native *board, uint64_t us)
{
    uint64_t until = board->now + us * (NATIVE_TICK_HZ / 1000000u);
    self = board;
    serve(board);
    /* A START that waits is checked often enough to begin in time. */
    while (board->period == 0u && board->core.start.waiting && board->now + WAIT_TICKS < until) {
        board->now += WAIT_TICKS;
        pulses(board);
        serve(board);
    }
    while (board->period != 0u && board->due <= until) {
        board->now = board->due;
        pulses(board);
        board->due = next_due(board);
        evlcp_chip(&board->core);
        serve(board);
    }
    if (board->now < until)
        board->now = until;
    pulses(board);
    serve(board);
}

/* Bytes arrive. */
void board_input(struct native *board, const uint8_t *bytes, size_t count)
{
    self = board;
    evlcp_receive(&board->core, bytes, (uint32_t)count);
}
