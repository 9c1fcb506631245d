/* SAVE and RECALL: two flash slots written in turn, each with a sequence number and CRCs. */
#include "crc32.h"
#include "evlcp.h"

#define MAGIC 0x45564c33u
#define CHUNK 256u

/* A slot's header as it stands in the flash. */
struct slot {
    uint32_t sequence;
    bool autostart;
    uint8_t watchdog;
    uint16_t level_ma;
    uint32_t watchdog_ms;
    uint16_t level_limit_ma;
    uint16_t duty_limit;
    uint8_t key[EVLCP_KEY_BYTES];
    struct evlcp_plan plan;
};

static void put_header(const struct slot *s, uint8_t b[EVLCP_SLOT_HEADER_BYTES])
{
    const struct evlcp_setup *setup = &s->plan.setup;
    for (uint32_t i = 0; i < EVLCP_SLOT_HEADER_BYTES; i++)
        b[i] = 0u;
    evlcp_put32(b, MAGIC);
    evlcp_put32(b + 4, s->sequence);
    b[8] = s->autostart ? 1u : 0u;
    b[9] = s->watchdog;
    evlcp_put16(b + 10, s->level_ma);
    evlcp_put32(b + 12, s->watchdog_ms);
    b[16] = s->plan.format;
    b[17] = setup->profile;
    b[18] = setup->preamble_chips;
    b[19] = setup->pilot_every;
    /* Chips alone have neither frames nor preamble nor pilots, and a firmware that does not know them takes no packet
       without frames. */
    bool chips = setup->hold != 0u;
    evlcp_put16(b + 20, chips ? 0u : setup->frames);
    evlcp_put16(b + 22, s->plan.packets);
    evlcp_put32(b + 24, chips ? setup->chips : setup->preamble);
    evlcp_put32(b + 28, s->plan.length);
    evlcp_put32(b + 32, s->plan.crc);
    evlcp_put32(b + 36, setup->chip_rate_hz);
    if (chips) {
        b[40] = setup->hold;
        b[41] = (uint8_t)setup->clusters;
    } else {
        for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
            evlcp_put16(b + 40 + 2u * k, setup->pilots[k]);
    }
    evlcp_copy(b + 72, setup->digest, 32u);
    evlcp_put16(b + 104, s->level_limit_ma);
    evlcp_put16(b + 106, s->duty_limit);
    evlcp_copy(b + 108, s->key, EVLCP_KEY_BYTES);
    evlcp_put32(b + EVLCP_SLOT_HEADER_BYTES - 4u, evlcp_crc32(0u, b, EVLCP_SLOT_HEADER_BYTES - 4u));
}

/* False if the slot is empty, torn, or of a board with another tick rate. */
static bool get_header(struct evlcp *e, uint8_t index, struct slot *s)
{
    uint8_t b[EVLCP_SLOT_HEADER_BYTES];
    struct evlcp_setup *setup = &s->plan.setup;
    if (!hal_flash_read(index, 0u, b, sizeof b) || evlcp_get32(b) != MAGIC ||
        evlcp_get32(b + sizeof b - 4u) != evlcp_crc32(0u, b, sizeof b - 4u))
        return false;
    *s = (struct slot){.sequence = evlcp_get32(b + 4),
                       .autostart = b[8] != 0u,
                       .watchdog = b[9],
                       .level_ma = evlcp_get16(b + 10),
                       .watchdog_ms = evlcp_get32(b + 12),
                       .level_limit_ma = evlcp_get16(b + 104),
                       .duty_limit = evlcp_get16(b + 106)};
    s->plan.format = b[16];
    setup->profile = b[17];
    setup->preamble_chips = b[18];
    setup->pilot_every = b[19];
    setup->frames = evlcp_get16(b + 20);
    s->plan.packets = evlcp_get16(b + 22);
    s->plan.length = evlcp_get32(b + 28);
    s->plan.crc = evlcp_get32(b + 32);
    setup->chip_rate_hz = evlcp_get32(b + 36);
    if (setup->frames == 0u) {
        setup->chips = evlcp_get32(b + 24);
        setup->hold = b[40];
        setup->clusters = b[41];
    } else {
        setup->preamble = evlcp_get32(b + 24);
        for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
            setup->pilots[k] = evlcp_get16(b + 40 + 2u * k);
    }
    evlcp_copy(setup->digest, b + 72, 32u);
    evlcp_copy(s->key, b + 108, EVLCP_KEY_BYTES);
    if (setup->chip_rate_hz == 0u || e->info.tick_hz % setup->chip_rate_hz != 0u)
        return false;
    setup->ticks_per_chip = e->info.tick_hz / setup->chip_rate_hz;
    return s->plan.length <= EVLCP_BANK_BYTES;
}

/* Read both headers; the slot with the newest that is whole, 0 if there is none. */
static uint8_t newest(struct evlcp *e, struct slot found[EVLCP_SLOTS], bool valid[EVLCP_SLOTS])
{
    for (uint8_t i = 0; i < EVLCP_SLOTS; i++)
        valid[i] = get_header(e, i, &found[i]);
    return valid[1] && (!valid[0] || (int32_t)(found[1].sequence - found[0].sequence) > 0) ? 1u : 0u;
}

enum evlcp_status evlcp_settings_save(struct evlcp *e, bool autostart, struct evlcp_save_reply *reply)
{
    uint8_t active = atomic_load(&e->banks.active);
    struct slot found[EVLCP_SLOTS];
    bool valid[EVLCP_SLOTS];
    uint8_t header[EVLCP_SLOT_HEADER_BYTES];
    if ((e->info.capabilities & EVLCP_CAPABILITY_FLASH) == 0u)
        return EVLCP_STATUS_NOT_SUPPORTED;
    /* Erasing stops the processor on single-bank parts: chips would come late, a LED test would stand still. */
    if (atomic_load(&e->player.running) || atomic_load(&e->player.want_play) || e->test.on)
        return EVLCP_STATUS_BUSY;
    if (active == EVLCP_NO_BANK || e->banks.stream[active].on)
        return EVLCP_STATUS_NOTHING_COMMITTED;
    /* Into the slot that is empty or older: the newest stays if the power fails meanwhile. */
    uint8_t last = newest(e, found, valid);
    uint8_t to = valid[last] ? (uint8_t)(1u - last) : 0u;
    uint32_t sequence = valid[last] ? found[last].sequence + 1u : 1u;
    struct slot slot = {.sequence = sequence,
                              .autostart = autostart,
                              .watchdog = e->watch.action,
                              .level_ma = e->level_ma,
                              .watchdog_ms = e->watch.timeout_ms,
                              .level_limit_ma = e->level_limit_ma,
                              .duty_limit = e->duty_limit,
                              .plan = e->banks.plan[active]};
    evlcp_copy(slot.key, e->trust.key, EVLCP_KEY_BYTES);
    put_header(&slot, header);
    /* The header goes last: until it is complete the slot is empty. */
    if (!hal_flash_erase(to) ||
        !hal_flash_write(to, EVLCP_SLOT_HEADER_BYTES, e->banks.content[active], slot.plan.length) ||
        !hal_flash_write(to, 0u, header, sizeof header))
        return EVLCP_STATUS_FLASH_FAULT;
    /* Read back what the flash took. */
    uint32_t crc = 0u;
    for (uint32_t at = 0; at < slot.plan.length; at += CHUNK) {
        uint8_t bytes[CHUNK];
        uint32_t count = slot.plan.length - at < CHUNK ? slot.plan.length - at : CHUNK;
        if (!hal_flash_read(to, EVLCP_SLOT_HEADER_BYTES + at, bytes, count))
            return EVLCP_STATUS_FLASH_FAULT;
        crc = evlcp_crc32(crc, bytes, count);
    }
    struct slot back;
    if (crc != slot.plan.crc || !get_header(e, to, &back) || back.sequence != sequence)
        return EVLCP_STATUS_FLASH_FAULT;
    reply->slot = to;
    reply->save_sequence = sequence;
    return EVLCP_STATUS_OK;
}

/* Load one slot into the spare bank and commit it. */
static enum evlcp_status load(struct evlcp *e, uint8_t index, const struct slot *s)
{
    uint8_t bank = atomic_load(&e->banks.active) == 0u ? 1u : 0u;
    uint32_t detail = 0u;
    struct evlcp_commit_request request = {.bank = bank,
                                           .format = s->plan.format,
                                           .packets = s->plan.packets,
                                           .length = s->plan.length,
                                           .crc = s->plan.crc};
    evlcp_copy(request.digest, s->plan.setup.digest, sizeof request.digest);
    e->banks.plan[bank].valid = false;
    if (!hal_flash_read(index, EVLCP_SLOT_HEADER_BYTES, e->banks.content[bank], s->plan.length))
        return EVLCP_STATUS_FLASH_FAULT;
    enum evlcp_status status = evlcp_banks_check(&e->banks, &s->plan.setup, &request, &detail);
    if (status != EVLCP_STATUS_OK)
        return status;
    if (s->level_limit_ma > e->info.level_max_ma || s->level_ma > s->level_limit_ma || s->duty_limit > 1000u ||
        !evlcp_light(e, s->level_ma, s->level_limit_ma, s->duty_limit))
        return EVLCP_STATUS_HARDWARE_FAULT;
    if (e->banks.plan[bank].duty > evlcp_allowed(e, s->level_ma, e->duty_limit))
        return EVLCP_STATUS_TOO_BRIGHT;
    e->setup = s->plan.setup;
    e->watch.action = s->watchdog <= EVLCP_WATCHDOG_DARK ? s->watchdog : EVLCP_WATCHDOG_KEEP;
    e->watch.timeout_ms = s->watchdog_ms;
    evlcp_activate(e, bank);
    return EVLCP_STATUS_OK;
}

enum evlcp_status evlcp_settings_recall(struct evlcp *e, bool only_autostart, struct evlcp_recall_reply *reply)
{
    struct slot found[EVLCP_SLOTS];
    bool valid[EVLCP_SLOTS];
    if ((e->info.capabilities & EVLCP_CAPABILITY_FLASH) == 0u)
        return EVLCP_STATUS_NOT_SUPPORTED;
    if (atomic_load(&e->player.running) || atomic_load(&e->banks.pending) != EVLCP_NO_BANK || e->test.on)
        return EVLCP_STATUS_BUSY;
    uint8_t first = newest(e, found, valid);
    for (uint8_t turn = 0; turn < EVLCP_SLOTS; turn++) {
        uint8_t i = turn == 0u ? first : (uint8_t)(1u - first);
        if (!valid[i])
            continue;
        if (only_autostart && !found[i].autostart)
            break;
        /* A slot whose content is damaged leaves the other, older one. */
        if (load(e, i, &found[i]) == EVLCP_STATUS_OK) {
            reply->slot = i;
            reply->save_sequence = found[i].sequence;
            return EVLCP_STATUS_OK;
        }
    }
    return EVLCP_STATUS_EMPTY_SLOT;
}

void evlcp_settings_key(struct evlcp *e)
{
    struct slot found[EVLCP_SLOTS];
    bool valid[EVLCP_SLOTS];
    if ((e->info.capabilities & EVLCP_CAPABILITY_FLASH) == 0u)
        return;
    /* Not that of an older slot, whatever RECALL does: a key that was changed is not believed again. */
    uint8_t last = newest(e, found, valid);
    if (valid[last])
        evlcp_trust_set(&e->trust, found[last].key);
}
