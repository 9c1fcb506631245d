#include "banks.h"

#include "codebook.h"
#include "crc32.h"
#include "guard.h"
#include "profiles.h"

_Static_assert(EVLCP_CLUSTERS == EVLCP_BOARD_CLUSTERS, "codebook and board have other clusters");

void evlcp_banks_init(struct evlcp_banks *banks)
{
    atomic_store(&banks->active, EVLCP_NO_BANK);
    atomic_store(&banks->pending, EVLCP_NO_BANK);
}

void evlcp_setup_init(struct evlcp_setup *setup, uint32_t tick_hz)
{
    *setup = (struct evlcp_setup){.profile = EVLCP_PROFILE_WH4X2,
                                  .preamble_chips = EVLCP_PREAMBLE_CHIPS,
                                  .preamble = evlcp_preamble,
                                  .frames = 10u,
                                  .pilot_every = 1u,
                                  .chip_rate_hz = 10000u,
                                  .ticks_per_chip = tick_hz / 10000u};
    for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
        setup->pilots[k] = evlcp_pilots[k];
    evlcp_copy(setup->digest, evlcp_digest, 32u);
}

static bool are_equal(const uint8_t *a, const uint8_t *b, uint32_t count)
{
    uint32_t differ = 0u;
    for (uint32_t i = 0; i < count; i++)
        differ |= (uint32_t)(a[i] ^ b[i]);
    return differ == 0u;
}

bool evlcp_profile_digest_ok(uint8_t profile, const uint8_t digest[32])
{
    if (profile == EVLCP_PROFILE_CUSTOM)
        return true;
    return profile < EVLCP_PROFILES && are_equal(digest, evlcp_profile_digests[profile], 32u);
}

bool evlcp_banks_range_ok(uint8_t bank, uint32_t offset, uint32_t count)
{
    return bank < EVLCP_BANKS && offset <= EVLCP_BANK_BYTES && count <= EVLCP_BANK_BYTES - offset;
}

bool evlcp_banks_in_use(const struct evlcp_banks *banks, uint8_t bank)
{
    /* Pending first: the chip interrupt moves a bank from pending to active between the two reads. */
    return bank == atomic_load(&banks->pending) || bank == atomic_load(&banks->active);
}

/* Whether a bank in use is already as requested. */
static bool is_committed(const struct evlcp_plan *plan, const struct evlcp_setup *setup,
                    const struct evlcp_commit_request *request)
{
    return plan->valid && plan->format == request->format && plan->packets == request->packets &&
           plan->length == request->length && plan->crc == request->crc &&
           are_equal((const uint8_t *)&plan->setup, (const uint8_t *)setup, sizeof *setup) &&
           are_equal(setup->digest, request->digest, 32u);
}

/* How content of a format is laid out, and what of the setup it is played with. False: not together. */
static bool make_plan(struct evlcp_plan *plan, const struct evlcp_setup *setup, uint8_t format)
{
    bool chips = setup->hold != 0u;
    if (chips ? setup->chips == 0u || setup->chips > EVLCP_BANK_BYTES
              : setup->frames == 0u || setup->pilot_every == 0u)
        return false;
    *plan = (struct evlcp_plan){.setup = *setup, .format = format, .packet_chips = evlcp_packet_chips(setup)};
    for (uint32_t i = 0; i < EVLCP_ROW_BYTES; i++)
        plan->lit[i] = 0xffu;
    uint32_t packet = chips ? setup->chips : plan->packet_chips; /* in the bank */
    switch (format) {
    case EVLCP_FORMAT_WORDS:
        plan->packet_bytes = setup->frames * EVLCP_FRAME_BYTES;
        return !chips;
    case EVLCP_FORMAT_MASKS:
        plan->chip_bytes = EVLCP_ROW_BYTES;
        break;
    case EVLCP_FORMAT_CLUSTERS:
        if (!chips || setup->clusters == 0u || setup->clusters > EVLCP_LEDS)
            return false;
        plan->chip_bytes = (uint8_t)((setup->clusters + 7u) / 8u);
        plan->table_bytes = setup->clusters * EVLCP_ROW_BYTES;
        break;
    default:
        return false;
    }
    plan->packet_bytes = packet * plan->chip_bytes;
    return true;
}

/* The LEDs of all clusters. False: one is in two of them, whose share of light would be that of neither. */
static bool read_table(struct evlcp_plan *plan, const uint8_t *content, uint32_t *detail)
{
    if (plan->table_bytes == 0u)
        return true;
    for (uint32_t i = 0; i < EVLCP_ROW_BYTES; i++)
        plan->lit[i] = 0u;
    for (uint32_t k = 0; k < plan->setup.clusters; k++) {
        for (uint32_t i = 0; i < EVLCP_ROW_BYTES; i++, content++) {
            if ((plan->lit[i] & *content) != 0u) {
                *detail = k;
                return false;
            }
            plan->lit[i] |= *content;
        }
    }
    return true;
}

enum evlcp_status evlcp_banks_stream(struct evlcp_banks *banks, const struct evlcp_setup *setup,
                                     const struct evlcp_stream_request *request, uint32_t *detail)
{
    if (request->bank >= EVLCP_BANKS)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, EVLCP_BANKS - 1u);
    if (evlcp_banks_in_use(banks, request->bank))
        return EVLCP_STATUS_BUSY;
    struct evlcp_plan *plan = &banks->plan[request->bank];
    struct evlcp_stream *stream = &banks->stream[request->bank];
    plan->valid = stream->on = false;
    if (!make_plan(plan, setup, request->format))
        return EVLCP_STATUS_OUT_OF_RANGE;
    if (!are_equal(request->digest, setup->digest, 32u) || !evlcp_profile_digest_ok(setup->profile, setup->digest))
        return EVLCP_STATUS_FOREIGN_CODEBOOK;
    /* One that plays, one that is put in meanwhile. */
    uint32_t room = EVLCP_BANK_BYTES - plan->table_bytes;
    if (plan->packet_bytes > room / 2u)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, 0u);
    if (!read_table(plan, banks->content[request->bank], detail))
        return EVLCP_STATUS_OUT_OF_RANGE;
    evlcp_stream_begin(stream, plan->packet_bytes, plan->table_bytes, room);
    plan->packets = (uint16_t)stream->slots;
    plan->valid = true; /* its duty is unknown: the guard checks each row */
    return EVLCP_STATUS_OK;
}

enum evlcp_status evlcp_banks_check(struct evlcp_banks *banks, const struct evlcp_setup *setup,
                                    const struct evlcp_commit_request *request, uint32_t *detail)
{
    if (request->bank >= EVLCP_BANKS)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, EVLCP_BANKS - 1u);
    struct evlcp_plan *plan = &banks->plan[request->bank];
    const uint8_t *content = banks->content[request->bank];
    if (evlcp_banks_in_use(banks, request->bank))
        return is_committed(plan, setup, request) ? EVLCP_STATUS_OK : EVLCP_STATUS_BUSY;
    plan->valid = banks->stream[request->bank].on = false;
    if (request->packets == 0u || !make_plan(plan, setup, request->format))
        return EVLCP_STATUS_OUT_OF_RANGE;
    uint32_t most = (EVLCP_BANK_BYTES - plan->table_bytes) / plan->packet_bytes;
    if (request->packets > most)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, most);
    uint32_t length = plan->table_bytes + plan->packet_bytes * request->packets;
    if (request->length != length)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, length);
    if (!are_equal(request->digest, setup->digest, 32u) || !evlcp_profile_digest_ok(setup->profile, setup->digest))
        return EVLCP_STATUS_FOREIGN_CODEBOOK;
    uint32_t crc = evlcp_crc32(0u, content, request->length);
    if (crc != request->crc)
        return evlcp_refuse(EVLCP_STATUS_BAD_CRC, detail, crc);
    if (!read_table(plan, content, detail))
        return EVLCP_STATUS_OUT_OF_RANGE;
    plan->packets = request->packets;
    plan->length = request->length;
    plan->crc = crc;
    plan->duty = evlcp_guard_duty(plan, content);
    plan->valid = true;
    return EVLCP_STATUS_OK;
}

bool evlcp_banks_swap(struct evlcp_banks *banks)
{
    uint8_t bank = atomic_load(&banks->pending);
    if (bank == EVLCP_NO_BANK)
        return false;
    atomic_store(&banks->active, bank);
    atomic_store(&banks->pending, EVLCP_NO_BANK);
    return true;
}
