#include "stream.h"

void evlcp_stream_begin(struct evlcp_stream *stream, uint32_t packet_bytes, uint32_t base, uint32_t room)
{
    stream->on = true;
    stream->slots = room / packet_bytes;
    stream->base = base;
    stream->packet_bytes = packet_bytes;
    stream->filled = 0u;
    atomic_store(&stream->pushed, 0u);
    atomic_store(&stream->ended, false);
    atomic_store(&stream->begun, 0u);
    atomic_store(&stream->underruns, 0u);
    atomic_store(&stream->starved, false);
}

void evlcp_stream_push(struct evlcp_stream *stream, uint8_t *content, uint32_t number, uint32_t offset,
                       const uint8_t *bytes, uint32_t count)
{
    uint32_t pushed = atomic_load(&stream->pushed);
    /* The packet that began last still plays from its slot. */
    uint32_t waiting = pushed - atomic_load(&stream->begun);
    if (number != pushed || offset != stream->filled || count > stream->packet_bytes - offset ||
        waiting + 1u >= stream->slots || atomic_load(&stream->ended))
        return;
    evlcp_copy(content + stream->base + (number % stream->slots) * stream->packet_bytes + offset, bytes, count);
    stream->filled += count;
    if (stream->filled == stream->packet_bytes) {
        stream->filled = 0u;
        atomic_store(&stream->pushed, pushed + 1u);
    }
}

void evlcp_stream_end(struct evlcp_stream *stream)
{
    atomic_store(&stream->ended, true);
    atomic_store(&stream->pushed, atomic_load(&stream->begun));
}

bool evlcp_stream_is_over(const struct evlcp_stream *stream)
{
    return stream->on && atomic_load(&stream->ended) && atomic_load(&stream->begun) == atomic_load(&stream->pushed);
}

enum evlcp_stream_next evlcp_stream_take(struct evlcp_stream *stream, bool hold, uint32_t *slot)
{
    uint32_t begun = atomic_load(&stream->begun);
    /* The end first: what was put in before it is seen then. */
    bool ended = atomic_load(&stream->ended);
    uint32_t pushed = atomic_load(&stream->pushed);
    if (hold)
        return EVLCP_STREAM_IDLE;
    if (begun != pushed) {
        atomic_store(&stream->starved, false);
        atomic_store(&stream->begun, begun + 1u);
        *slot = begun % stream->slots;
        return EVLCP_STREAM_PACKET;
    }
    if (ended) {
        atomic_store(&stream->starved, false);
        return EVLCP_STREAM_END;
    }
    if (pushed != 0u && !atomic_load(&stream->starved)) {
        atomic_store(&stream->starved, true);
        atomic_store(&stream->underruns, atomic_load(&stream->underruns) + 1u);
    }
    return EVLCP_STREAM_IDLE;
}
