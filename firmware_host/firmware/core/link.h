/* Datagrams over a byte line: receive ring, COBS, CRC. */
#pragma once

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#define EVLCP_BODY_BYTES (EVLCP_HEADER_BYTES + EVLCP_MAX_PAYLOAD + EVLCP_CRC_BYTES)
#define EVLCP_WIRE_BYTES (EVLCP_BODY_BYTES + EVLCP_BODY_BYTES / 254u + 2u)
#define EVLCP_RING_BYTES 4096u

_Static_assert(EVLCP_WINDOW * EVLCP_WIRE_BYTES < EVLCP_RING_BYTES, "a full window must fit the ring");

struct evlcp_datagram {
    uint8_t type;
    uint8_t status;
    uint16_t sequence;
    uint16_t session;
    const uint8_t *payload;
    uint32_t length;
};

struct evlcp_link {
    /* Filled by evlcp_link_push in the receive interrupt, emptied by evlcp_link_next: one writer each. */
    uint8_t ring[EVLCP_RING_BYTES];
    atomic_uint_least32_t head;
    atomic_uint_least32_t tail;
    atomic_uint_least32_t overflow_errors;

    uint8_t body[EVLCP_WIRE_BYTES]; /* as it comes, then decoded; full: too long, drop until the delimiter */
    uint32_t length;                /* bytes since the last delimiter */
    uint32_t crc_errors;
    uint32_t framing_errors;

    uint8_t wire[EVLCP_WIRE_BYTES];
    uint32_t wire_length;
    uint32_t wire_sent;
};

/* Take received bytes; those that find no room are counted as overflow. Safe in an interrupt. */
void evlcp_link_push(struct evlcp_link *link, const uint8_t *bytes, uint32_t count);

/* Next good datagram of what was received, or false. It stays valid until one is put or the next is taken. */
bool evlcp_link_next(struct evlcp_link *link, struct evlcp_datagram *datagram);

/* Encode a datagram of at most EVLCP_MAX_PAYLOAD bytes payload for sending; the last one must be sent. */
void evlcp_link_put(struct evlcp_link *link, const struct evlcp_datagram *datagram);

/* Hand encoded bytes to hal_send; true when all are gone. */
bool evlcp_link_flush(struct evlcp_link *link);
