/* SAVE and RECALL: two flash slots written in turn, each with a sequence number and CRCs. */
#include "crc32.h"
#include "evlcp.h"

#define MAGIC 0x45564c33u

/* False if the slot is empty, torn, or of a board with another tick rate. */
static bool get_slot(struct evlcp *e, uint8_t index, struct evlcp_saved *s)
{
    hal_flash_read(index, 0u, (uint8_t *)s, sizeof *s);
    return s->magic == MAGIC && s->check == evlcp_crc32(0u, (uint8_t *)s, sizeof *s - 4u) && s->chip_rate_hz != 0u &&
           e->info.tick_hz % s->chip_rate_hz == 0u && s->length <= EVLCP_BANK_BYTES;
}

/* Read both headers; the slot with the newest that is whole, 0 if there is none. */
static uint8_t newest(struct evlcp *e, struct evlcp_saved found[EVLCP_SLOTS], bool valid[EVLCP_SLOTS])
{
    for (uint8_t i = 0; i < EVLCP_SLOTS; i++)
        valid[i] = get_slot(e, i, &found[i]);
    return valid[1] && (!valid[0] || (int32_t)(found[1].sequence - found[0].sequence) > 0) ? 1u : 0u;
}

enum evlcp_status on_save(struct evlcp *e, struct exchange *x)
{
    uint8_t autostart = x->in[0];
    uint8_t active = atomic_load(&e->banks.active);
    struct evlcp_saved found[EVLCP_SLOTS];
    bool valid[EVLCP_SLOTS];
    if (autostart > 1u)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, &x->detail, 1u);
    if (active == EVLCP_NO_BANK || e->banks.stream[active].on)
        return EVLCP_STATUS_NOTHING_COMMITTED;
    /* Into the slot that is empty or older: the newest stays if the power fails meanwhile. */
    uint8_t last = newest(e, found, valid);
    uint8_t to = valid[last] ? (uint8_t)(1u - last) : 0u;
    uint32_t sequence = valid[last] ? found[last].sequence + 1u : 1u;
    const struct evlcp_plan *plan = &e->banks.plan[active];
    const struct evlcp_setup *setup = &plan->setup;
    struct evlcp_saved slot = {.magic = MAGIC,
                              .sequence = sequence,
                              .autostart = autostart,
                              .watchdog = e->watch.action,
                              .level_ma = e->level_ma,
                              .watchdog_ms = e->watch.timeout_ms,
                              .format = plan->format,
                              .profile = setup->profile,
                              .preamble_chips = setup->preamble_chips,
                              .pilot_every = setup->pilot_every,
                              .packets = plan->packets,
                              .length = plan->length,
                              .crc = plan->crc,
                              .chip_rate_hz = setup->chip_rate_hz,
                              .level_limit_ma = e->level_limit_ma,
                              .duty_limit = e->duty_limit};
    /* Chips alone have neither frames nor preamble nor pilots, and a firmware that does not know them takes no packet
       without frames. */
    if (setup->hold != 0u) {
        slot.preamble = setup->chips;
        slot.pilots[0] = (uint16_t)(setup->hold | setup->clusters << 8);
    } else {
        slot.frames = setup->frames;
        slot.preamble = setup->preamble;
        for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
            slot.pilots[k] = setup->pilots[k];
    }
    evlcp_copy(slot.digest, setup->digest, sizeof slot.digest);
    evlcp_copy(slot.key, e->trust.key, sizeof slot.key);
    const uint8_t *header = (const uint8_t *)&slot;
    slot.check = evlcp_crc32(0u, header, sizeof slot - 4u);
    /* The header goes last: until it is complete the slot is empty. */
    if (!hal_flash_erase(to) ||
        !hal_flash_write(to, sizeof(struct evlcp_saved), e->banks.content[active], slot.length) ||
        !hal_flash_write(to, 0u, header, sizeof slot))
        return EVLCP_STATUS_FLASH_FAULT;
    /* Read back what the flash took. */
    struct evlcp_saved back;
    if (evlcp_flash_crc(to, sizeof(struct evlcp_saved), slot.length) != slot.crc || !get_slot(e, to, &back) ||
        back.sequence != sequence)
        return EVLCP_STATUS_FLASH_FAULT;
    const struct evlcp_save_reply reply = {.slot = to, .save_sequence = sequence};
    return evlcp_answer(x, &reply, sizeof reply);
}

/* Load one slot into the spare bank and commit it. */
static enum evlcp_status load(struct evlcp *e, uint8_t index, const struct evlcp_saved *s)
{
    uint8_t bank = atomic_load(&e->banks.active) == 0u ? 1u : 0u;
    uint32_t detail = 0u;
    struct evlcp_setup setup = {.chip_rate_hz = s->chip_rate_hz,
                                .ticks_per_chip = e->info.tick_hz / s->chip_rate_hz,
                                .frames = s->frames,
                                .profile = s->profile,
                                .preamble_chips = s->preamble_chips,
                                .pilot_every = s->pilot_every};
    struct evlcp_commit_request request = {
        .bank = bank, .format = s->format, .packets = s->packets, .length = s->length, .crc = s->crc};
    if (s->frames == 0u) {
        setup.chips = s->preamble;
        setup.hold = (uint8_t)s->pilots[0];
        setup.clusters = s->pilots[0] >> 8;
    } else {
        setup.preamble = s->preamble;
        for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
            setup.pilots[k] = s->pilots[k];
    }
    evlcp_copy(setup.digest, s->digest, sizeof setup.digest);
    evlcp_copy(request.digest, s->digest, sizeof request.digest);
    e->banks.plan[bank].valid = false;
    hal_flash_read(index, sizeof(struct evlcp_saved), e->banks.content[bank], s->length);
    enum evlcp_status status = evlcp_banks_check(&e->banks, &setup, &request, &detail);
    if (status != EVLCP_STATUS_OK)
        return status;
    if (s->level_limit_ma > e->info.level_max_ma || s->level_ma > s->level_limit_ma || s->duty_limit > 1000u ||
        !evlcp_set_light(e, s->level_ma, s->level_limit_ma, s->duty_limit))
        return EVLCP_STATUS_HARDWARE_FAULT;
    if (e->banks.plan[bank].duty > evlcp_allowed_duty(e, s->level_ma, e->duty_limit))
        return EVLCP_STATUS_TOO_BRIGHT;
    e->setup = setup;
    e->watch.action = s->watchdog <= EVLCP_WATCHDOG_DARK ? s->watchdog : EVLCP_WATCHDOG_KEEP;
    e->watch.timeout_ms = s->watchdog_ms;
    evlcp_activate(e, bank);
    return EVLCP_STATUS_OK;
}

enum evlcp_status evlcp_settings_recall(struct evlcp *e, bool only_autostart, struct evlcp_recall_reply *reply)
{
    struct evlcp_saved found[EVLCP_SLOTS];
    bool valid[EVLCP_SLOTS];
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

void evlcp_settings_load_key(struct evlcp *e)
{
    struct evlcp_saved found[EVLCP_SLOTS];
    bool valid[EVLCP_SLOTS];
    /* Not that of an older slot, whatever RECALL does: a key that was changed is not believed again. */
    uint8_t last = newest(e, found, valid);
    if (valid[last])
        evlcp_trust_set_key(&e->trust, found[last].key);
}
