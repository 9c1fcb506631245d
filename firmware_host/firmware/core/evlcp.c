#include "evlcp.h"

#include "crc32.h"

#define HEALTH_EVERY_MS 100u
#define WATCHDOG_MIN_MS 100u
#define RESTART_AFTER_MS 20u /* the answer has left by then */
#define HOLDS_DARK (EVLCP_FAULT_OVER_TEMPERATURE | EVLCP_FAULT_CLOCK)

static const uint8_t dark[EVLCP_ROW_BYTES];

static bool is_running(struct evlcp *e)
{
    return atomic_load(&e->player.running);
}

static uint16_t fault_bits(struct evlcp *e)
{
    uint32_t bits = e->health.faults | e->latched;
    if (atomic_load(&e->player.chip_lost))
        bits |= EVLCP_FAULT_CHIP_LOST;
    if (atomic_load(&e->player.over_limit))
        bits |= EVLCP_FAULT_OVER_LIMIT;
    if (e->start.missed)
        bits |= EVLCP_FAULT_PULSE;
    if (e->watch.acted)
        bits |= EVLCP_FAULT_WATCHDOG;
    uint8_t bank = atomic_load(&e->banks.active);
    if (bank != EVLCP_NO_BANK && e->banks.stream[bank].on && atomic_load(&e->banks.stream[bank].starved))
        bits |= EVLCP_FAULT_UNDERRUN;
    return (uint16_t)bits;
}

static void end_led_test(struct evlcp *e)
{
    if (!e->test.on)
        return;
    hal_show_leds(dark, EVLCP_CHIP_DARK);
    (void)hal_set_level(e->level_ma);
    e->test.on = false;
}

static void show_test_led(const struct evlcp *e)
{
    uint8_t row[EVLCP_ROW_BYTES] = {0};
    row[e->test.led / 8u] = (uint8_t)(0x80u >> (e->test.led % 8u));
    hal_show_leds(row, EVLCP_CHIP_TEST);
}

void evlcp_activate(struct evlcp *e, uint8_t bank)
{
    e->banks.commits++;
    atomic_store(&e->banks.pending, bank);
    /* While chips run the chip interrupt swaps; if it has just ended, evlcp_poll does. */
    if (!is_running(e))
        (void)evlcp_banks_swap(&e->banks);
}

uint32_t evlcp_allowed_duty(const struct evlcp *e, uint32_t level_ma, uint32_t duty_limit)
{
    uint32_t most = level_ma > e->info.mean_max_ma ? 1000u * e->info.mean_max_ma / level_ma : 1000u;
    return most < duty_limit ? most : duty_limit;
}

bool evlcp_set_light(struct evlcp *e, uint16_t level_ma, uint16_t level_limit_ma, uint16_t duty_limit)
{
    e->level_limit_ma = level_limit_ma;
    e->duty_limit = duty_limit;
    uint32_t duty = evlcp_allowed_duty(e, level_ma, duty_limit);
    uint32_t old = atomic_load(&e->player.guard.duty);
    /* What plays meanwhile keeps to the lower of both. */
    if (duty < old)
        atomic_store(&e->player.guard.duty, duty);
    if (!hal_set_level(level_ma))
        return false;
    e->level_ma = level_ma;
    atomic_store(&e->player.guard.duty, duty);
    return true;
}

/* Whether a bank, if there is one, allows for so small a share. */
static bool is_dim_enough(const struct evlcp *e, uint8_t bank, uint32_t allowed)
{
    return bank == EVLCP_NO_BANK || e->banks.plan[bank].duty <= allowed;
}

/* What plays, or would with the next START, must not end in the dark. */
static bool are_banks_dim_enough(const struct evlcp *e, uint32_t allowed)
{
    return is_dim_enough(e, atomic_load(&e->banks.pending), allowed) &&
           is_dim_enough(e, atomic_load(&e->banks.active), allowed);
}

static enum evlcp_status out_of_range(struct exchange *x, uint32_t nearest)
{
    return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, &x->detail, nearest);
}

enum evlcp_status evlcp_answer(struct exchange *x, const void *payload, uint32_t bytes)
{
    evlcp_copy(x->out, payload, bytes);
    x->out_length = bytes;
    return EVLCP_STATUS_OK;
}

/* ---- requests ---- */

static enum evlcp_status on_hello(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_hello_request request = *(const struct evlcp_hello_request *)x->in;
    if (request.major != EVLCP_PROTOCOL_MAJOR) {
        static const uint8_t version[4] = {EVLCP_PROTOCOL_MAJOR, EVLCP_PROTOCOL_MINOR};
        return evlcp_refuse(EVLCP_STATUS_INCOMPATIBLE, &x->detail, evlcp_get32(version));
    }
    if (e->session == EVLCP_NO_SESSION || request.nonce != e->nonce) {
        uint16_t session = (uint16_t)(request.nonce ^ request.nonce >> 16);
        while (session == EVLCP_NO_SESSION || session == e->session)
            session++;
        e->session = session;
        e->nonce = request.nonce;
        e->control.known = false;
        e->control.newest = x->sequence;
        e->control.sequence = x->sequence;
        evlcp_trust_begin_session(&e->trust, x->sequence);
    }
    const struct evlcp_hal_info *info = &e->info;
    struct evlcp_hello_reply reply = {
        .major = EVLCP_PROTOCOL_MAJOR,
        .minor = EVLCP_PROTOCOL_MINOR,
        .session = e->session,
        .version_major = EVLCP_VERSION_MAJOR,
        .version_minor = EVLCP_VERSION_MINOR,
        .version_patch = EVLCP_VERSION_PATCH,
        .window = EVLCP_WINDOW,
        .max_payload = EVLCP_MAX_PAYLOAD,
        .banks = EVLCP_BANKS,
        .bank_bytes = EVLCP_BANK_BYTES,
        .clusters = EVLCP_BOARD_CLUSTERS,
        .leds = EVLCP_LEDS,
        .tick_hz = info->tick_hz,
        .chip_rate_max_hz = info->chip_rate_max_hz,
        .level_max_ma = info->level_max_ma,
        .mean_max_ma = info->mean_max_ma,
        .burst_chips = info->burst_chips,
        .capabilities = info->capabilities | EVLCP_CAPABILITY_STREAM,
        .uptime_ms = hal_millis(),
        .clock_hz = info->clock_hz,
        .formats = 1u << EVLCP_FORMAT_WORDS | 1u << EVLCP_FORMAT_MASKS | 1u << EVLCP_FORMAT_CLUSTERS,
        .chip_rate_min_hz = 1u + (info->tick_hz - 1u) / info->ticks_per_chip_max};
    if (e->trust.able) {
        reply.capabilities |= EVLCP_CAPABILITY_TRUST;
        evlcp_copy(reply.challenge, e->trust.challenge, sizeof reply.challenge);
        evlcp_trust_key_name(&e->trust, reply.key_name);
    }
    evlcp_copy(reply.unique_id, info->unique_id, sizeof reply.unique_id);
    evlcp_copy(reply.hal, info->name, sizeof reply.hal);
    return evlcp_answer(x, &reply, sizeof reply);
}

static bool is_chip_rate_ok(const struct evlcp_hal_info *info, uint32_t rate_hz)
{
    return rate_hz != 0u && rate_hz <= info->chip_rate_max_hz && info->tick_hz % rate_hz == 0u &&
           info->tick_hz / rate_hz <= info->ticks_per_chip_max;
}

/* The chip rate nearest to `rate_hz` that the board can play, the lower of two. */
static uint32_t nearest_chip_rate(const struct evlcp_hal_info *info, uint32_t rate_hz)
{
    uint32_t from = rate_hz < info->chip_rate_max_hz ? rate_hz : info->chip_rate_max_hz;
    for (uint32_t step = 0; step <= info->chip_rate_max_hz; step++) {
        if (step <= from && is_chip_rate_ok(info, from - step))
            return from - step;
        if (is_chip_rate_ok(info, from + step))
            return from + step;
    }
    return 0u;
}

static enum evlcp_status on_configure(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_configure_request request = *(const struct evlcp_configure_request *)x->in;
    if (!is_chip_rate_ok(&e->info, request.chip_rate_hz))
        return out_of_range(x, nearest_chip_rate(&e->info, request.chip_rate_hz));
    uint32_t most = EVLCP_BANK_BYTES / EVLCP_FRAME_BYTES;
    if (request.frames == 0u || request.frames > most)
        return out_of_range(x, request.frames == 0u ? 1u : most);
    if (request.pilot_every == 0u)
        return out_of_range(x, 1u);
    if (request.profile > EVLCP_PROFILE_RAW8 && request.profile != EVLCP_PROFILE_CUSTOM)
        return out_of_range(x, EVLCP_PROFILE_CUSTOM);
    if (request.level_limit_ma > e->info.level_max_ma || request.duty_limit > 1000u)
        return out_of_range(x, request.duty_limit > 1000u ? 1000u : e->info.level_max_ma);
    uint16_t limit = request.level_limit_ma != 0u ? request.level_limit_ma : e->level_limit_ma;
    uint16_t share = request.duty_limit != 0u ? request.duty_limit : e->duty_limit;
    uint16_t level_ma = e->level_ma < limit ? e->level_ma : limit;
    uint32_t allowed = evlcp_allowed_duty(e, level_ma, share);
    if (request.duty_limit != 0u && !are_banks_dim_enough(e, allowed))
        return evlcp_refuse(EVLCP_STATUS_TOO_BRIGHT, &x->detail, allowed);
    if (!evlcp_set_light(e, level_ma, limit, share))
        return EVLCP_STATUS_HARDWARE_FAULT;
    e->setup.chip_rate_hz = request.chip_rate_hz;
    e->setup.ticks_per_chip = e->info.tick_hz / request.chip_rate_hz;
    e->setup.profile = request.profile;
    e->setup.frames = request.frames;
    e->setup.pilot_every = request.pilot_every;
    const struct evlcp_configure_reply reply = {
        .ticks_per_chip = e->setup.ticks_per_chip,
        .packet_chips = evlcp_packet_chips(&e->setup)};
    return evlcp_answer(x, &reply, sizeof reply);
}

static enum evlcp_status on_codebook(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_codebook_request request = *(const struct evlcp_codebook_request *)x->in;
    if (request.preamble_chips == 0u || request.preamble_chips > 32u)
        return out_of_range(x, 32u);
    if (!evlcp_profile_digest_ok(e->setup.profile, request.digest))
        return EVLCP_STATUS_FOREIGN_CODEBOOK;
    if (e->setup.profile != EVLCP_PROFILE_CUSTOM) {
        struct evlcp_setup own;
        evlcp_setup_init(&own, e->info.tick_hz);
        bool same = own.preamble == request.preamble && own.preamble_chips == request.preamble_chips;
        for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
            same = same && own.pilots[k] == request.pilots[k];
        if (!same)
            return EVLCP_STATUS_FOREIGN_CODEBOOK;
    }
    e->setup.preamble_chips = request.preamble_chips;
    e->setup.preamble = request.preamble;
    for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
        e->setup.pilots[k] = request.pilots[k];
    e->setup.hold = 0u;
    e->setup.clusters = 0u;
    e->setup.chips = 0u;
    evlcp_copy(e->setup.digest, request.digest, sizeof e->setup.digest);
    return EVLCP_STATUS_OK;
}

static enum evlcp_status on_chips(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_chips_request request = *(const struct evlcp_chips_request *)x->in;
    if (request.packet_chips == 0u || request.packet_chips > EVLCP_BANK_BYTES)
        return out_of_range(x, request.packet_chips == 0u ? 1u : EVLCP_BANK_BYTES);
    if (request.hold == 0u || request.clusters > EVLCP_LEDS)
        return out_of_range(x, request.hold == 0u ? 1u : EVLCP_LEDS);
    e->setup.profile = EVLCP_PROFILE_CUSTOM;
    e->setup.hold = request.hold;
    e->setup.clusters = request.clusters;
    e->setup.chips = request.packet_chips;
    evlcp_copy(e->setup.digest, request.digest, sizeof e->setup.digest);
    return EVLCP_STATUS_OK;
}

static enum evlcp_status on_write(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_write_request to = *(const struct evlcp_write_request *)x->in;
    uint32_t count = x->in_length - (uint32_t)sizeof to;
    if (!evlcp_banks_range_ok(to.bank, to.offset, count))
        return out_of_range(x, EVLCP_BANK_BYTES);
    if (evlcp_banks_in_use(&e->banks, to.bank))
        return EVLCP_STATUS_BUSY;
    e->banks.plan[to.bank].valid = false;
    evlcp_copy(e->banks.content[to.bank] + to.offset, x->in + sizeof to, count);
    const struct evlcp_write_reply reply = {.bank = to.bank, .offset = to.offset, .count = (uint16_t)count};
    return evlcp_answer(x, &reply, sizeof reply);
}

static enum evlcp_status on_read(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_read_request request = *(const struct evlcp_read_request *)x->in;
    const struct evlcp_read_reply reply = {.bank = request.bank, .offset = request.offset};
    const uint32_t most = EVLCP_MAX_PAYLOAD - (uint32_t)sizeof reply;
    if (!evlcp_banks_range_ok(request.bank, request.offset, request.count) || request.count > most)
        return out_of_range(x, most);
    evlcp_copy(x->out + sizeof reply, e->banks.content[request.bank] + request.offset, request.count);
    (void)evlcp_answer(x, &reply, sizeof reply);
    x->out_length += request.count;
    return EVLCP_STATUS_OK;
}

static enum evlcp_status on_crc(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_crc_request request = *(const struct evlcp_crc_request *)x->in;
    if (!evlcp_banks_range_ok(request.bank, request.offset, request.length))
        return out_of_range(x, EVLCP_BANK_BYTES);
    const struct evlcp_crc_reply reply = {
        .crc = evlcp_crc32(0u, e->banks.content[request.bank] + request.offset, request.length)};
    return evlcp_answer(x, &reply, sizeof reply);
}

static enum evlcp_status on_commit(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_commit_request request = *(const struct evlcp_commit_request *)x->in;
    uint8_t active = atomic_load(&e->banks.active);
    uint8_t pending = atomic_load(&e->banks.pending);
    bool held = request.bank < EVLCP_BANKS && evlcp_banks_in_use(&e->banks, request.bank);
    /* Another bank waits for its packet boundary. */
    if (pending != EVLCP_NO_BANK && pending != request.bank)
        return EVLCP_STATUS_BUSY;
    /* The chip timer is not changed while it runs: a chip of another length would be torn. */
    if (is_running(e) && e->setup.ticks_per_chip != e->banks.plan[active].setup.ticks_per_chip)
        return evlcp_refuse(EVLCP_STATUS_BUSY, &x->detail, e->banks.plan[active].setup.chip_rate_hz);
    enum evlcp_status status = evlcp_banks_check(&e->banks, &e->setup, &request, &x->detail);
    if (status != EVLCP_STATUS_OK)
        return status;
    uint32_t allowed = evlcp_allowed_duty(e, e->level_ma, e->duty_limit);
    if (!is_dim_enough(e, request.bank, allowed))
        return evlcp_refuse(EVLCP_STATUS_TOO_BRIGHT, &x->detail, allowed);
    if (!held)
        evlcp_activate(e, request.bank);
    const struct evlcp_commit_reply reply = {.commits = e->banks.commits};
    return evlcp_answer(x, &reply, sizeof reply);
}

static enum evlcp_status on_stream(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_stream_request request = *(const struct evlcp_stream_request *)x->in;
    uint8_t active = atomic_load(&e->banks.active);
    if (atomic_load(&e->banks.pending) != EVLCP_NO_BANK)
        return EVLCP_STATUS_BUSY;
    if (is_running(e) && e->setup.ticks_per_chip != e->banks.plan[active].setup.ticks_per_chip)
        return evlcp_refuse(EVLCP_STATUS_BUSY, &x->detail, e->banks.plan[active].setup.chip_rate_hz);
    enum evlcp_status status = evlcp_banks_stream(&e->banks, &e->setup, &request, &x->detail);
    if (status != EVLCP_STATUS_OK)
        return status;
    evlcp_activate(e, request.bank);
    const struct evlcp_stream_reply reply = {.slots = (uint16_t)e->banks.stream[request.bank].slots};
    return evlcp_answer(x, &reply, sizeof reply);
}

static enum evlcp_status on_push(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_push_request request = *(const struct evlcp_push_request *)x->in;
    if (request.bank >= EVLCP_BANKS)
        return out_of_range(x, EVLCP_BANKS - 1u);
    struct evlcp_stream *stream = &e->banks.stream[request.bank];
    if (!stream->on)
        return EVLCP_STATUS_NOTHING_COMMITTED;
    uint32_t count = x->in_length - (uint32_t)sizeof request;
    if (count != 0u)
        evlcp_stream_push(stream, e->banks.content[request.bank], request.number, request.offset,
                          x->in + sizeof request, count);
    const struct evlcp_push_reply reply = {.number = atomic_load(&stream->pushed),
                                           .offset = (uint16_t)stream->filled,
                                           .begun = atomic_load(&stream->begun),
                                           .underruns = atomic_load(&stream->underruns)};
    /* The end holds once everything before it is there. */
    if (request.last == 1u && reply.offset == 0u && reply.number == request.number + (count != 0u ? 1u : 0u))
        atomic_store(&stream->ended, true);
    return evlcp_answer(x, &reply, sizeof reply);
}

static enum evlcp_status start(struct evlcp *e, uint32_t *detail)
{
    uint8_t pending = atomic_load(&e->banks.pending);
    uint8_t bank = pending != EVLCP_NO_BANK ? pending : atomic_load(&e->banks.active);
    if (bank == EVLCP_NO_BANK || evlcp_stream_is_over(&e->banks.stream[bank]))
        return EVLCP_STATUS_NOTHING_COMMITTED;
    hal_read_health(&e->health);
    if ((e->health.faults & HOLDS_DARK) != 0u) {
        *detail = e->health.faults;
        return EVLCP_STATUS_HARDWARE_FAULT;
    }
    e->latched = 0u;
    atomic_store(&e->player.chip_lost, false);
    atomic_store(&e->player.over_limit, false);
    e->start = (struct evlcp_start){.waiting = false};
    end_led_test(e);
    /* evlcp_poll begins; so a START that meets the end of a STOP is not lost. */
    atomic_store(&e->player.want_play, true);
    return EVLCP_STATUS_OK;
}

static enum evlcp_status on_start(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_start_request request = *(const struct evlcp_start_request *)x->in;
    struct evlcp_pulse pulse;
    bool waits = request.at_pulse != 0u || request.at_clock != 0u;
    if (waits && (e->info.capabilities & EVLCP_CAPABILITY_PULSE) == 0u)
        return EVLCP_STATUS_NOT_SUPPORTED;
    if (waits && (is_running(e) || atomic_load(&e->player.want_play)))
        return EVLCP_STATUS_BUSY;
    if (request.at_pulse != 0u) {
        uint8_t bank = atomic_load(&e->banks.active);
        uint32_t rate = bank != EVLCP_NO_BANK ? e->banks.plan[bank].setup.chip_rate_hz : e->setup.chip_rate_hz;
        (void)hal_read_pulse(&pulse);
        /* It takes two pulses to know how far they are apart, and one that comes. */
        if ((int32_t)(request.at_pulse - pulse.count) < (pulse.between != 0u ? 1 : 3))
            return out_of_range(x, pulse.count + 3u);
        if (request.pulse_hz == 0u || rate % request.pulse_hz != 0u)
            return out_of_range(x, 1u);
    }
    enum evlcp_status status = start(e, &x->detail);
    if (status == EVLCP_STATUS_OK && waits)
        e->start = (struct evlcp_start){.waiting = true,
                                        .at_pulse = request.at_pulse,
                                        .pulse_hz = request.pulse_hz,
                                        .at_clock = request.at_clock};
    return status;
}

static enum evlcp_status on_level(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_level_request request = *(const struct evlcp_level_request *)x->in;
    if (request.level_ma > e->level_limit_ma)
        return out_of_range(x, e->level_limit_ma);
    uint32_t allowed = evlcp_allowed_duty(e, request.level_ma, e->duty_limit);
    if (!are_banks_dim_enough(e, allowed))
        return evlcp_refuse(EVLCP_STATUS_TOO_BRIGHT, &x->detail, allowed);
    end_led_test(e);
    return evlcp_set_light(e, request.level_ma, e->level_limit_ma, e->duty_limit) ? EVLCP_STATUS_OK
                                                                               : EVLCP_STATUS_HARDWARE_FAULT;
}

static uint8_t current_state(struct evlcp *e)
{
    if (is_running(e)) {
        if (!atomic_load(&e->player.want_play))
            return EVLCP_STATE_STOPPING;
        return e->player.idle ? EVLCP_STATE_IDLE_PATTERN : EVLCP_STATE_PLAYING;
    }
    if (e->test.on)
        return EVLCP_STATE_TESTING;
    if ((fault_bits(e) & (HOLDS_DARK | EVLCP_FAULT_CHIP_LOST | EVLCP_FAULT_OVER_LIMIT)) != 0u)
        return EVLCP_STATE_FAULT;
    if (e->start.waiting && atomic_load(&e->player.want_play))
        return EVLCP_STATE_WAITING;
    /* Between START and its first chip. */
    return atomic_load(&e->player.want_play) ? EVLCP_STATE_PLAYING : EVLCP_STATE_DARK;
}

static enum evlcp_status on_status(struct evlcp *e, struct exchange *x)
{
    struct evlcp_pulse pulse;
    (void)hal_read_pulse(&pulse);
    struct evlcp_status_reply reply = {
        .state = current_state(e),
        .faults = fault_bits(e),
        .pending_bank = atomic_load(&e->banks.pending), /* first, as in evlcp_banks_in_use */
        .commits = e->banks.commits,
        .packets_sent = atomic_load(&e->player.packets_sent),
        .chips_sent = atomic_load(&e->player.chips_sent),
        .lateness_ticks = atomic_load(&e->player.lateness),
        .lateness_max_ticks = atomic_load(&e->player.lateness_max),
        .crc_errors = e->link.crc_errors,
        .framing_errors = e->link.framing_errors,
        .overflow_errors = atomic_load(&e->link.overflow_errors),
        .requests = e->requests,
        .level_ma = e->level_ma,
        .level_limit_ma = e->level_limit_ma,
        .duty_limit = e->duty_limit,
        .temperature_dc = e->health.temperature_dc,
        .watchdog = e->watch.action,
        .watchdog_ms = e->watch.timeout_ms,
        .silence_ms = hal_millis() - e->watch.silence_from_ms,
        .uptime_ms = hal_millis(),
        .clock = hal_clock(),
        .pulses = pulse.count,
        .pulse_clocks = pulse.between};
    reply.active_bank = atomic_load(&e->banks.active);
    const struct evlcp_setup *setup = &e->setup;
    if (reply.active_bank != EVLCP_NO_BANK) {
        const struct evlcp_plan *plan = &e->banks.plan[reply.active_bank];
        setup = &plan->setup;
        reply.format = plan->format;
        reply.packets = plan->packets;
        reply.length = plan->length;
        reply.duty = plan->duty;
        reply.crc = plan->crc;
        reply.packet_chips = plan->packet_chips;
        reply.hold = setup->hold;
        reply.clusters = (uint8_t)setup->clusters;
        if (e->banks.stream[reply.active_bank].on)
            reply.underruns = atomic_load(&e->banks.stream[reply.active_bank].underruns);
    }
    reply.profile = setup->profile;
    reply.frames = setup->frames;
    reply.pilot_every = setup->pilot_every;
    reply.chip_rate_hz = setup->chip_rate_hz;
    evlcp_copy(reply.digest, setup->digest, sizeof reply.digest);
    evlcp_copy(reply.open_leds, e->health.open_leds, sizeof reply.open_leds);
    return evlcp_answer(x, &reply, sizeof reply);
}

static enum evlcp_status on_watchdog(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_watchdog_request request = *(const struct evlcp_watchdog_request *)x->in;
    if (request.action > EVLCP_WATCHDOG_DARK)
        return out_of_range(x, EVLCP_WATCHDOG_DARK);
    if (request.action != EVLCP_WATCHDOG_KEEP && request.timeout_ms < WATCHDOG_MIN_MS)
        return out_of_range(x, WATCHDOG_MIN_MS);
    e->watch.action = request.action;
    e->watch.timeout_ms = request.timeout_ms;
    return EVLCP_STATUS_OK;
}

static enum evlcp_status on_recall(struct evlcp *e, struct exchange *x)
{
    struct evlcp_recall_reply reply = {0};
    enum evlcp_status status = evlcp_settings_recall(e, false, &reply);
    return status == EVLCP_STATUS_OK ? evlcp_answer(x, &reply, sizeof reply) : status;
}

static enum evlcp_status on_led_test(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_led_test_request request = *(const struct evlcp_led_test_request *)x->in;
    if (is_running(e) || atomic_load(&e->player.want_play))
        return EVLCP_STATUS_BUSY;
    if (request.last >= EVLCP_LEDS || request.first > request.last)
        return out_of_range(x, EVLCP_LEDS - 1u);
    if (request.dwell_ms == 0u)
        return out_of_range(x, 1u);
    hal_read_health(&e->health);
    if ((e->health.faults & HOLDS_DARK) != 0u)
        return evlcp_refuse(EVLCP_STATUS_HARDWARE_FAULT, &x->detail, e->health.faults);
    /* A LED is on for as long as the host likes: with no more than the mean that it may have. */
    uint32_t most = (uint32_t)e->level_ma * evlcp_allowed_duty(e, e->level_ma, e->duty_limit) / 1000u;
    if (!hal_set_level((uint16_t)most))
        return evlcp_refuse(EVLCP_STATUS_HARDWARE_FAULT, &x->detail, 0u);
    e->test.on = true;
    e->test.led = request.first;
    e->test.last = request.last;
    e->test.dwell_ms = request.dwell_ms;
    e->test.since_ms = hal_millis();
    show_test_led(e);
    return EVLCP_STATUS_OK;
}

/* No packet is taken from now on, and none of a stream is left for another START. */
static void stop_playing(struct evlcp *e)
{
    atomic_store(&e->player.want_play, false);
    for (uint8_t bank = 0; bank < EVLCP_BANKS; bank++)
        evlcp_stream_end(&e->banks.stream[bank]);
}

static enum evlcp_status on_key(struct evlcp *e, struct exchange *x)
{
    if (!e->trust.able)
        return EVLCP_STATUS_NOT_SUPPORTED;
    evlcp_trust_set_key(&e->trust, x->in);
    return EVLCP_STATUS_OK;
}

static enum evlcp_status on_stop(struct evlcp *e, struct exchange *x)
{
    (void)x;
    stop_playing(e);
    end_led_test(e);
    return EVLCP_STATUS_OK;
}

static enum evlcp_status on_blank(struct evlcp *e, struct exchange *x)
{
    (void)x;
    stop_playing(e);
    evlcp_player_blank(&e->player);
    end_led_test(e);
    return EVLCP_STATUS_OK;
}

struct shape {
    enum evlcp_status (*handle)(struct evlcp *e, struct exchange *x);
    uint8_t type;
    bool control;
    bool query;
    bool dark;
    uint32_t needs; /* capability */
    bool open_ended;
    uint16_t least;
    uint16_t bytes;
};

#define SHAPE(name, ...) {on_##name, __VA_ARGS__},
static const struct shape shapes[] = {EVLCP_REQUESTS(SHAPE)};

static const struct shape *shape_of(uint8_t type)
{
    for (uint32_t i = 0; i < sizeof shapes / sizeof shapes[0]; i++) {
        if (shapes[i].type == type)
            return &shapes[i];
    }
    return 0;
}

/* Sequence numbers wrap; half of them are after `than`. */
static bool is_after(uint16_t sequence, uint16_t than)
{
    return (int16_t)(uint16_t)(sequence - than) > 0;
}

static enum evlcp_status run(struct evlcp *e, const struct shape *shape, struct exchange *x)
{
    if ((e->info.capabilities & shape->needs) != shape->needs)
        return EVLCP_STATUS_NOT_SUPPORTED;
    /* Erasing stops the processor on single-bank parts: chips would come late, a LED test would stand still. */
    if (shape->dark && (is_running(e) || atomic_load(&e->player.want_play) || e->test.on))
        return EVLCP_STATUS_BUSY;
    return shape->handle(e, x);
}

static enum evlcp_status run_control(struct evlcp *e, const struct shape *shape, struct exchange *x)
{
    struct evlcp_control *c = &e->control;
    enum evlcp_status status = run(e, shape, x);
    *c = (struct evlcp_control){.known = true,
                                .type = shape->type,
                                .status = (uint8_t)status,
                                .sequence = x->sequence,
                                .newest = c->newest,
                                .length = x->out_length};
    evlcp_copy(c->reply, x->out, x->out_length);
    if (status != EVLCP_STATUS_OK)
        evlcp_put32(c->reply, x->detail);
    return status;
}

/* What the watchdog did is reported until a control request, as a host that returns sends HELLO first. */
static void note_host(struct evlcp *e)
{
    e->watch.host_ms = hal_millis();
    e->watch.fired = false;
    atomic_store(&e->player.want_idle, false);
}

static enum evlcp_status dispatch(struct evlcp *e, const struct evlcp_datagram *d, bool sealed, struct exchange *x)
{
    /* A host without the key may read the state, but not change it, nor reset the watchdog. */
    bool trusted = sealed || !e->trust.locked;
    const struct shape *shape = shape_of(d->type);
    if (shape == 0)
        return EVLCP_STATUS_UNKNOWN_TYPE;
    if (d->length < shape->least || (d->length > shape->bytes && !shape->open_ended))
        return evlcp_refuse(EVLCP_STATUS_BAD_LENGTH, &x->detail, shape->bytes);
    /* Of an earlier minor version: what it does not have is zero. */
    uint8_t whole[EVLCP_REQUEST_MOST] = {0};
    if (d->length < shape->bytes) {
        evlcp_copy(whole, d->payload, d->length);
        x->in = whole;
        x->in_length = shape->bytes;
    }
    if (d->type == EVLCP_TYPE_HELLO) {
        enum evlcp_status status = on_hello(e, x);
        if (status == EVLCP_STATUS_OK && trusted)
            note_host(e);
        return status;
    }
    if (d->session != e->session || e->session == EVLCP_NO_SESSION)
        return EVLCP_STATUS_NO_SESSION;
    struct evlcp_control *c = &e->control;
    /* The latest control request once more, a KEY, say, whose answer was lost: answered again, but not done again. */
    bool again = shape->control && c->known && d->sequence == c->sequence && d->type == c->type;
    if (!trusted && !shape->query && !again)
        return EVLCP_STATUS_NEEDS_KEY;
    if (trusted) {
        note_host(e);
        if (d->type != EVLCP_TYPE_STATUS)
            e->watch.silence_from_ms = e->watch.host_ms;
    }
    if (trusted && is_after(d->sequence, c->newest)) {
        c->newest = d->sequence;
        /* Keep the last control request within the half of the numbers that counts as before. */
        if ((uint16_t)(c->newest - c->sequence) > 0x4000u) {
            c->sequence = (uint16_t)(c->newest - 0x4000u);
            c->known = false;
        }
    }
    if (shape->control)
        e->watch.acted = e->watch.acted && !trusted;
    if (again) {
        evlcp_copy(x->out, c->reply, c->length);
        x->out_length = c->length;
        x->detail = evlcp_get32(c->reply);
        return (enum evlcp_status)c->status;
    }
    if (!shape->query && !is_after(d->sequence, c->sequence))
        return EVLCP_STATUS_STALE;
    if (shape->control)
        return run_control(e, shape, x);
    enum evlcp_status status = run(e, shape, x);
    if (trusted && d->type == EVLCP_TYPE_STATUS)
        e->watch.silence_from_ms = e->watch.host_ms; /* after it, as the status reports the silence */
    return status;
}

static void answer(struct evlcp *e, struct evlcp_datagram *d)
{
    struct exchange x = {.sequence = d->sequence, .in = d->payload, .out = e->payload};
    bool sealed = false;
    /* Replies go to hosts; one that comes here was echoed by the line. */
    if ((d->type & EVLCP_REPLY_BIT) != 0u)
        return;
    e->requests++;
    enum evlcp_status status = EVLCP_STATUS_OK;
    if (d->session == e->session && e->session != EVLCP_NO_SESSION)
        status = evlcp_trust_unseal(&e->trust, d, &sealed);
    x.in_length = d->length;
    if (status == EVLCP_STATUS_OK)
        status = dispatch(e, d, sealed, &x);
    if (status != EVLCP_STATUS_OK) {
        evlcp_put32(e->payload, x.detail);
        x.out_length = 4u;
    }
    const struct evlcp_datagram reply = {.type = (uint8_t)(d->type | EVLCP_REPLY_BIT),
                                         .status = (uint8_t)status,
                                         .sequence = d->sequence,
                                         .session = e->session,
                                         .payload = e->payload,
                                         .length = x.out_length};
    evlcp_link_put(&e->link, &reply);
}

/* ---- what happens by itself ---- */

static void check_watchdog(struct evlcp *e, uint32_t now)
{
    if (e->watch.action == EVLCP_WATCHDOG_KEEP || e->watch.fired ||
        now - e->watch.host_ms < e->watch.timeout_ms || !atomic_load(&e->player.want_play))
        return;
    e->watch.fired = true;
    e->watch.acted = true;
    if (e->watch.action == EVLCP_WATCHDOG_IDLE)
        atomic_store(&e->player.want_idle, true);
    else
        atomic_store(&e->player.want_play, false);
}

static void check_health(struct evlcp *e, uint32_t now)
{
    if (now - e->health_ms < HEALTH_EVERY_MS)
        return;
    e->health_ms = now;
    hal_read_health(&e->health);
    if ((e->health.faults & HOLDS_DARK) == 0u)
        return;
    e->latched |= e->health.faults & HOLDS_DARK;
    /* Whatever lights the LEDs, even if an earlier fault is still latched. */
    if (is_running(e) || atomic_load(&e->player.want_play) || e->test.on) {
        atomic_store(&e->player.want_play, false);
        evlcp_player_blank(&e->player);
        end_led_test(e);
    }
}

static void step_led_test(struct evlcp *e, uint32_t now)
{
    if (!e->test.on || now - e->test.since_ms < e->test.dwell_ms)
        return;
    e->test.since_ms += e->test.dwell_ms;
    if (e->test.led == e->test.last) {
        end_led_test(e);
        return;
    }
    e->test.led++;
    show_test_led(e);
}

void evlcp_init(struct evlcp *e)
{
    /* The LEDs first: nothing may light them before a COMMIT. */
    hal_show_leds(dark, EVLCP_CHIP_DARK);
    hal_get_info(&e->info);
    evlcp_banks_init(&e->banks);
    evlcp_setup_init(&e->setup, e->info.tick_hz);
    e->watch.host_ms = e->watch.silence_from_ms = hal_millis();
    if (e->info.burst_chips > EVLCP_BURST_MOST)
        e->info.burst_chips = EVLCP_BURST_MOST;
    e->player.guard.burst = 1000u * e->info.burst_chips;
    (void)evlcp_set_light(e, e->info.level_default_ma, e->info.level_max_ma, 1000u);
    hal_read_health(&e->health);
    e->health_ms = hal_millis();
    if ((e->info.capabilities & EVLCP_CAPABILITY_FLASH) == 0u)
        return;
    evlcp_settings_load_key(e);
    struct evlcp_recall_reply recalled;
    uint32_t detail;
    if (evlcp_settings_recall(e, true, &recalled) == EVLCP_STATUS_OK)
        (void)start(e, &detail);
}

void evlcp_receive(struct evlcp *e, const uint8_t *bytes, uint32_t count)
{
    evlcp_link_push(&e->link, bytes, count);
}

void evlcp_chip(struct evlcp *e)
{
    evlcp_player_chip(&e->player, &e->banks);
}

void evlcp_hardware_failed(struct evlcp *e)
{
    atomic_store(&e->player.want_play, false);
    evlcp_player_blank(&e->player);
    end_led_test(e);
    hal_read_health(&e->health);
    e->latched |= e->health.faults & HOLDS_DARK;
    if ((e->health.faults & HOLDS_DARK) == 0u)
        atomic_store(&e->player.chip_lost, true);
}

/* Whether chips may begin: at once, or soon enough for the hardware to wait for the exact moment. */
static bool is_start_due(struct evlcp *e)
{
    if (!e->start.waiting)
        return true;
    struct evlcp_when when = {.at = e->start.at_clock};
    if (e->start.at_pulse != 0u) {
        struct evlcp_pulse pulse;
        (void)hal_read_pulse(&pulse);
        /* Not while it is farther away than half the range of the clock. */
        if (pulse.between == 0u ||
            (int32_t)(e->start.at_pulse - pulse.count) > (int32_t)(INT32_MAX / pulse.between))
            return false;
        when.at = pulse.at + (e->start.at_pulse - pulse.count) * pulse.between;
        when.pulse = e->start.at_pulse;
        when.pulse_hz = e->start.pulse_hz;
        when.chip_rate_hz = e->banks.plan[atomic_load(&e->banks.active)].setup.chip_rate_hz;
    }
    if ((int32_t)(when.at - hal_clock()) > (int32_t)(e->info.clock_hz / 1000000u * EVLCP_START_LEAD_US))
        return false;
    e->start.waiting = false;
    hal_schedule_start(&when);
    return true;
}

void evlcp_poll(struct evlcp *e)
{
    struct evlcp_datagram datagram;
    if (evlcp_link_flush(&e->link) && evlcp_link_next(&e->link, &datagram)) {
        answer(e, &datagram);
        (void)evlcp_link_flush(&e->link);
    }
    uint32_t now = hal_millis(); /* after the answer, which has its own: no time before it is compared with it */
    uint32_t lost = hal_lost_bytes();
    if (lost != 0u)
        atomic_fetch_add(&e->link.overflow_errors, lost);
    if (!is_running(e)) {
        if (!e->player.rests)
            e->player.dark_ms = now;
        e->player.rests = true;
        (void)evlcp_banks_swap(&e->banks);
        if (atomic_load(&e->player.chip_lost) || atomic_load(&e->player.over_limit))
            atomic_store(&e->player.want_play, false);
        if (atomic_load(&e->player.want_play) && atomic_load(&e->banks.active) != EVLCP_NO_BANK && is_start_due(e))
            evlcp_player_begin(&e->player, &e->banks);
    }
    struct evlcp_pulse pulse;
    if (!hal_read_pulse(&pulse) && is_running(e))
        e->start.missed = true;
    check_watchdog(e, now);
    check_health(e, now);
    step_led_test(e, now);
    if (e->update.restart && now - e->update.restart_ms >= RESTART_AFTER_MS && !is_running(e))
        hal_restart();
}
