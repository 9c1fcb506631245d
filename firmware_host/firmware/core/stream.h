/* A bank as a queue of packets: the host puts them in, the player takes them out. */
#pragma once

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "composer.h"

#define EVLCP_STREAM_IDLE_CHIPS 2u /* an empty queue is checked again after these */

/* The main loop begins one while its bank is spare; then it writes `pushed`, `ended` and `filled`, and the chip
   interrupt the rest. */
struct evlcp_stream {
    bool on;
    uint32_t slots;
    uint32_t base; /* where the first slot begins */
    uint32_t packet_bytes;
    uint32_t filled;              /* bytes of the packet that is being put in */
    atomic_uint_least32_t pushed; /* whole packets put in */
    atomic_bool ended;            /* no further one comes */
    atomic_uint_least32_t begun;  /* packets that have begun to play */
    atomic_uint_least32_t underruns;
    atomic_bool starved; /* empty before its end */
};

/* What plays next. */
enum evlcp_stream_next {
    EVLCP_STREAM_PACKET, /* the one in `slot` */
    EVLCP_STREAM_IDLE,
    EVLCP_STREAM_END
};

/* An empty queue of packets of `packet_bytes` in the `room` bytes of a bank from `base` on; at least two must fit. */
void evlcp_stream_begin(struct evlcp_stream *stream, uint32_t packet_bytes, uint32_t base, uint32_t room);

/* Put a piece in, if it is the next one and there is room; `content` is the bank's. */
void evlcp_stream_push(struct evlcp_stream *stream, uint8_t *content, uint32_t number, uint32_t offset,
                       const uint8_t *bytes, uint32_t count);

/* End it, and drop what waits; while no packet is taken. */
void evlcp_stream_end(struct evlcp_stream *stream);

/* Whether it has ended, and all that was put in has begun to play. */
bool evlcp_stream_is_over(const struct evlcp_stream *stream);

/* Take the next packet out, at a packet boundary; what it held before may be overwritten from now on. `hold`: not
   now, show the idle pattern. */
enum evlcp_stream_next evlcp_stream_take(struct evlcp_stream *stream, bool hold, uint32_t *slot);
