#include "link.h"

#include "crc32.h"
#include "hal.h"

void evlcp_link_push(struct evlcp_link *link, const uint8_t *bytes, uint32_t count)
{
    uint32_t head = atomic_load_explicit(&link->head, memory_order_relaxed);
    uint32_t tail = atomic_load_explicit(&link->tail, memory_order_acquire);
    for (uint32_t i = 0; i < count; i++) {
        if (head - tail == EVLCP_RING_BYTES) {
            uint32_t lost = atomic_load_explicit(&link->overflow_errors, memory_order_relaxed);
            atomic_store_explicit(&link->overflow_errors, lost + (count - i), memory_order_relaxed);
            break;
        }
        link->ring[head % EVLCP_RING_BYTES] = bytes[i];
        head++;
    }
    atomic_store_explicit(&link->head, head, memory_order_release);
}

/* Decode COBS in place; the length, or 0 if it is none. */
static uint32_t decode(uint8_t *bytes, uint32_t count)
{
    uint32_t length = 0u;
    uint32_t at = 0u;
    while (at < count) {
        uint32_t code = bytes[at++];
        if (code - 1u > count - at)
            return 0u;
        evlcp_copy(bytes + length, bytes + at, code - 1u);
        length += code - 1u;
        at += code - 1u;
        if (code != 0xffu && at < count)
            bytes[length++] = 0u;
    }
    return length;
}

/* Whether the bytes before a delimiter are a good datagram; counts the others. */
static bool finish_datagram(struct evlcp_link *link, struct evlcp_datagram *datagram)
{
    uint8_t *b = link->body;
    uint32_t received = link->length;
    link->length = 0u;
    if (received == 0u)
        return false;
    uint32_t length = received < sizeof link->body ? decode(b, received) : 0u;
    if (length < EVLCP_HEADER_BYTES + EVLCP_CRC_BYTES || length > EVLCP_BODY_BYTES) {
        link->framing_errors++;
        return false;
    }
    length -= EVLCP_CRC_BYTES;
    if (evlcp_crc32(0u, b, length) != evlcp_get32(b + length)) {
        link->crc_errors++;
        return false;
    }
    datagram->type = b[0];
    datagram->status = b[1];
    datagram->sequence = evlcp_get16(b + 2);
    datagram->session = evlcp_get16(b + 4);
    datagram->payload = b + EVLCP_HEADER_BYTES;
    datagram->length = length - EVLCP_HEADER_BYTES;
    return true;
}

bool evlcp_link_next(struct evlcp_link *link, struct evlcp_datagram *datagram)
{
    uint32_t tail = atomic_load_explicit(&link->tail, memory_order_relaxed);
    uint32_t head = atomic_load_explicit(&link->head, memory_order_acquire);
    bool found = false;
    while (!found && tail != head) {
        uint8_t byte = link->ring[tail++ % EVLCP_RING_BYTES];
        if (byte == 0u)
            found = finish_datagram(link, datagram);
        else if (link->length < sizeof link->body)
            link->body[link->length++] = byte;
    }
    atomic_store_explicit(&link->tail, tail, memory_order_release);
    return found;
}

/* Encode as COBS with a delimiter; the length. */
static uint32_t encode(uint8_t *wire, const uint8_t *bytes, uint32_t count)
{
    uint32_t code_at = 0u;
    uint32_t length = 1u;
    for (uint32_t i = 0; i < count; i++) {
        if (length - code_at == 0xffu) {
            wire[code_at] = 0xffu;
            code_at = length++;
        }
        if (bytes[i] == 0u) {
            wire[code_at] = (uint8_t)(length - code_at);
            code_at = length++;
        } else {
            wire[length++] = bytes[i];
        }
    }
    wire[code_at] = (uint8_t)(length - code_at);
    wire[length++] = 0u;
    return length;
}

void evlcp_link_put(struct evlcp_link *link, const struct evlcp_datagram *datagram)
{
    uint8_t *b = link->body;
    uint32_t length = EVLCP_HEADER_BYTES + datagram->length;
    b[0] = datagram->type;
    b[1] = datagram->status;
    evlcp_put16(b + 2, datagram->sequence);
    evlcp_put16(b + 4, datagram->session);
    evlcp_copy(b + EVLCP_HEADER_BYTES, datagram->payload, datagram->length);
    evlcp_put32(b + length, evlcp_crc32(0u, b, length));
    link->wire_length = encode(link->wire, b, length + EVLCP_CRC_BYTES);
    link->wire_sent = 0u;
}

bool evlcp_link_flush(struct evlcp_link *link)
{
    if (link->wire_sent < link->wire_length)
        link->wire_sent += hal_send(link->wire + link->wire_sent, link->wire_length - link->wire_sent);
    return link->wire_sent == link->wire_length;
}
