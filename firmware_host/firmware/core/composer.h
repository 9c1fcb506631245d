/* Chips from a bank's content: preamble, pilots and info words become LED rows. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#define EVLCP_FRAME_CHIPS 32u
#define EVLCP_PILOT_CHIPS 16u
#define EVLCP_FRAME_BYTES (2u * EVLCP_BOARD_CLUSTERS)

/* What a COMMIT plays with; without gaps, so that two are the same if their bytes are. */
struct evlcp_setup {
    uint32_t preamble;
    uint32_t chip_rate_hz;
    uint32_t ticks_per_chip;
    uint32_t chips; /* of chips alone: of a packet in the bank; 0 with a codebook */
    uint16_t frames;
    uint16_t clusters; /* of CLUSTERS, whose masks stand before the chips */
    uint16_t pilots[EVLCP_BOARD_CLUSTERS];
    uint8_t profile;
    uint8_t preamble_chips;
    uint8_t pilot_every;
    uint8_t hold; /* of chips alone: chips that one of the content lasts; 0 with a codebook */
    uint8_t digest[32];
};

/* How a bank's content is played; fixed from COMMIT on. */
struct evlcp_plan {
    struct evlcp_setup setup;
    bool valid;
    uint8_t format;
    uint8_t chip_bytes; /* of a chip, in MASKS and CLUSTERS */
    uint16_t packets;
    uint16_t duty; /* share of time that the brightest LED is on, permille */
    uint32_t length;
    uint32_t crc;
    uint32_t packet_chips; /* of the chip rate */
    uint32_t table_bytes;  /* before the first packet */
    uint32_t packet_bytes;
    uint8_t lit[EVLCP_ROW_BYTES]; /* all LEDs that the content may light */
};

/* A place in the content. */
struct evlcp_cursor {
    const struct evlcp_plan *plan;
    const uint8_t *content;
    uint32_t packet;
    uint32_t chip;      /* of the packet */
    const uint8_t *at;  /* words of the frame, or what the chip is */
    uint8_t held;       /* chips that it has been shown */
    uint32_t in_frame;  /* chip of the frame; without a pilot it starts at EVLCP_PILOT_CHIPS */
    uint8_t to_pilot;   /* frames until the next one with a pilot */
};

/* Chips of a packet, by the chip rate; with a codebook the frames 0, pilot_every, ... have a pilot. */
uint32_t evlcp_packet_chips(const struct evlcp_setup *setup);

/* Go to the first chip of a packet. */
void evlcp_cursor_seek(struct evlcp_cursor *cursor, const struct evlcp_plan *plan, const uint8_t *content,
                       uint32_t packet);

/* The row of the chip at the cursor; the cursor moves on. True if it was the packet's last. */
bool evlcp_cursor_row(struct evlcp_cursor *cursor, uint8_t row[EVLCP_ROW_BYTES]);
