#include "composer.h"

_Static_assert(EVLCP_BOARD_CLUSTERS == 16u && EVLCP_LEDS == 96u && EVLCP_ROW_BYTES == 12u,
               "the row tables are made for 16 clusters of 6 LEDs");

_Static_assert(sizeof(struct evlcp_setup) == 88u, "setups are compared byte by byte");

uint32_t evlcp_packet_chips(const struct evlcp_setup *setup)
{
    if (setup->hold != 0u)
        return setup->chips * setup->hold;
    uint32_t pilots = ((uint32_t)setup->frames + setup->pilot_every - 1u) / setup->pilot_every;
    return setup->preamble_chips + (uint32_t)setup->frames * (EVLCP_FRAME_CHIPS - EVLCP_PILOT_CHIPS) +
           pilots * EVLCP_PILOT_CHIPS;
}

void evlcp_cursor_seek(struct evlcp_cursor *cursor, const struct evlcp_plan *plan, const uint8_t *content,
                       uint32_t packet)
{
    *cursor = (struct evlcp_cursor){.plan = plan,
                                    .content = content,
                                    .packet = packet,
                                    .at = content + plan->table_bytes + packet * plan->packet_bytes};
}

/* Spread a mask, cluster 0 its most significant bit, over the LEDs. */
static void row_of_mask(uint16_t mask, uint8_t row[EVLCP_ROW_BYTES])
{
    /* Four clusters are 24 LEDs are three bytes. */
    for (uint32_t group = 0; group < 4u; group++) {
        uint32_t four = (uint32_t)mask >> (12u - 4u * group) & 15u;
        uint32_t leds = ((four & 8u) ? 0xfc0000u : 0u) | ((four & 4u) ? 0x03f000u : 0u) |
                        ((four & 2u) ? 0x000fc0u : 0u) | ((four & 1u) ? 0x00003fu : 0u);
        row[3u * group] = (uint8_t)(leds >> 16);
        row[3u * group + 1u] = (uint8_t)(leds >> 8);
        row[3u * group + 2u] = (uint8_t)leds;
    }
}

/* Mask of a frame's chip: bit `shift` of each cluster's word. */
static uint16_t frame_mask(const struct evlcp_cursor *c)
{
    uint32_t mask = 0u;
    if (c->in_frame < EVLCP_PILOT_CHIPS) {
        uint32_t shift = EVLCP_PILOT_CHIPS - 1u - c->in_frame;
        for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
            mask = mask << 1 | ((uint32_t)c->plan->setup.pilots[k] >> shift & 1u);
    } else {
        uint32_t shift = EVLCP_FRAME_CHIPS - 1u - c->in_frame;
        for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++)
            mask = mask << 1 | ((uint32_t)evlcp_get16(c->at + 2u * k) >> shift & 1u);
    }
    return (uint16_t)mask;
}

/* The LEDs of the clusters whose bits are set; masks of clusters do not overlap. */
static void row_of_clusters(const struct evlcp_plan *plan, const uint8_t *masks, const uint8_t *bits,
                            uint8_t row[EVLCP_ROW_BYTES])
{
    uint32_t a = 0u;
    uint32_t b = 0u;
    uint32_t c = 0u;
    for (uint32_t left = plan->setup.clusters; left != 0u; bits++) {
        uint32_t here = left < 8u ? left : 8u;
        const uint8_t *mask = masks;
        /* No bit beyond the last cluster: there is no mask. */
        for (uint32_t byte = (uint32_t)*bits >> (8u - here) << (8u - here); byte != 0u; byte = byte << 1 & 0xffu) {
            if ((byte & 0x80u) != 0u) {
                a |= evlcp_get32(mask);
                b |= evlcp_get32(mask + 4);
                c |= evlcp_get32(mask + 8);
            }
            mask += EVLCP_ROW_BYTES;
        }
        masks += here * EVLCP_ROW_BYTES;
        left -= here;
    }
    evlcp_put32(row, a);
    evlcp_put32(row + 4, b);
    evlcp_put32(row + 8, c);
}

bool evlcp_cursor_row(struct evlcp_cursor *cursor, uint8_t row[EVLCP_ROW_BYTES])
{
    const struct evlcp_plan *plan = cursor->plan;
    if (plan->format != EVLCP_FORMAT_WORDS) {
        if (plan->format == EVLCP_FORMAT_MASKS)
            evlcp_copy(row, cursor->at, EVLCP_ROW_BYTES);
        else
            row_of_clusters(plan, cursor->content, cursor->at, row);
        if (++cursor->held >= plan->setup.hold) {
            cursor->held = 0u;
            cursor->at += plan->chip_bytes;
        }
    } else if (cursor->chip < plan->setup.preamble_chips) {
        uint32_t on = plan->setup.preamble >> (plan->setup.preamble_chips - 1u - cursor->chip) & 1u;
        row_of_mask(on ? 0xffffu : 0u, row);
    } else {
        row_of_mask(frame_mask(cursor), row);
        if (++cursor->in_frame == EVLCP_FRAME_CHIPS) {
            cursor->at += EVLCP_FRAME_BYTES;
            cursor->to_pilot = (uint8_t)((cursor->to_pilot == 0u ? plan->setup.pilot_every : cursor->to_pilot) - 1u);
            cursor->in_frame = cursor->to_pilot == 0u ? 0u : EVLCP_PILOT_CHIPS;
        }
    }
    return ++cursor->chip == plan->packet_chips;
}
