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

static void append(struct evlcp_link *link, uint8_t byte)
{
    if (link->length == EVLCP_BODY_BYTES) {
        link->broken = true;
        return;
    }
    link->body[link->length++] = byte;
}

/* Whether the delimiter ends a good datagram; counts the others. */
static bool finish_datagram(struct evlcp_link *link, struct evlcp_datagram *datagram)
{
    uint32_t length = link->length;
    bool good = link->open && !link->broken && link->left == 0u;
    bool empty = !link->open;
    link->length = 0u;
    link->left = 0u;
    link->full_block = true;
    link->open = false;
    link->broken = false;
    if (empty)
        return false;
    if (!good || length < EVLCP_HEADER_BYTES + EVLCP_CRC_BYTES) {
        link->framing_errors++;
        return false;
    }
    const uint8_t *b = link->body;
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

static bool decode_byte(struct evlcp_link *link, uint8_t byte, struct evlcp_datagram *datagram)
{
    if (byte == 0u)
        return finish_datagram(link, datagram);
    if (!link->open) {
        link->open = true;
        link->full_block = true; /* no zero stands before the first block */
    }
    if (link->broken)
        return false;
    if (link->left == 0u) {
        if (!link->full_block)
            append(link, 0u);
        link->left = (uint8_t)(byte - 1u);
        link->full_block = byte == 0xffu;
    } else {
        append(link, byte);
        link->left--;
    }
    return false;
}

bool evlcp_link_next(struct evlcp_link *link, struct evlcp_datagram *datagram)
{
    uint32_t tail = atomic_load_explicit(&link->tail, memory_order_relaxed);
    uint32_t head = atomic_load_explicit(&link->head, memory_order_acquire);
    bool found = false;
    while (!found && tail != head) {
        found = decode_byte(link, link->ring[tail % EVLCP_RING_BYTES], datagram);
        tail++;
    }
    atomic_store_explicit(&link->tail, tail, memory_order_release);
    return found;
}

struct encoder {
    uint8_t *wire;
    uint32_t length;
    uint32_t code_at;
};

static void encode_byte(struct encoder *e, uint8_t byte)
{
    uint32_t run = e->length - e->code_at; /* the code itself and the bytes after it */
    if (run == 0xffu) {
        e->wire[e->code_at] = 0xffu;
        e->code_at = e->length++;
        run = 1u;
    }
    if (byte == 0u) {
        e->wire[e->code_at] = (uint8_t)run;
        e->code_at = e->length++;
    } else {
        e->wire[e->length++] = byte;
    }
}

void evlcp_link_put(struct evlcp_link *link, const struct evlcp_datagram *datagram)
{
    uint8_t header[EVLCP_HEADER_BYTES];
    uint8_t tail[EVLCP_CRC_BYTES];
    header[0] = datagram->type;
    header[1] = datagram->status;
    evlcp_put16(header + 2, datagram->sequence);
    evlcp_put16(header + 4, datagram->session);
    uint32_t crc = evlcp_crc32(0u, header, EVLCP_HEADER_BYTES);
    evlcp_put32(tail, evlcp_crc32(crc, datagram->payload, datagram->length));

    struct encoder e = {.wire = link->wire, .length = 1u, .code_at = 0u};
    for (uint32_t i = 0; i < EVLCP_HEADER_BYTES; i++)
        encode_byte(&e, header[i]);
    for (uint32_t i = 0; i < datagram->length; i++)
        encode_byte(&e, datagram->payload[i]);
    for (uint32_t i = 0; i < EVLCP_CRC_BYTES; i++)
        encode_byte(&e, tail[i]);
    e.wire[e.code_at] = (uint8_t)(e.length - e.code_at);
    e.wire[e.length++] = 0u;
    link->wire_length = e.length;
    link->wire_sent = 0u;
}

bool evlcp_link_flush(struct evlcp_link *link)
{
    if (link->wire_sent < link->wire_length)
        link->wire_sent += hal_send(link->wire + link->wire_sent, link->wire_length - link->wire_sent);
    return link->wire_sent == link->wire_length;
}
