/* Unit tests of the core over the native HAL, run under address and undefined-behaviour sanitizers.

   The argument names the golden wire vectors, which the host's tests read too. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "board.h"
#include "codebook.h"
#include "crc32.h"
#include "profiles.h"

static unsigned passed;
static unsigned failed;

#define EXPECT(condition)                                                          \
    do {                                                                           \
        if (condition)                                                             \
            passed++;                                                              \
        else {                                                                     \
            failed++;                                                              \
            printf("%s:%d: in %s: %s\n", __FILE__, __LINE__, __func__, #condition); \
        }                                                                          \
    } while (0)

/* ---- a host in few lines ---- */

struct host {
    struct native *board;
    uint16_t sequence;
    uint16_t session;
    /* The last reply. */
    uint8_t type;
    uint8_t status;
    uint16_t reply_sequence;
    uint8_t payload[EVLCP_MAX_PAYLOAD];
    uint32_t length;
};

static uint32_t wire_of(const struct evlcp_datagram *d, uint8_t *wire)
{
    static struct evlcp_link link;
    evlcp_link_put(&link, d);
    memcpy(wire, link.wire, link.wire_length);
    return link.wire_length;
}

/* Decode one datagram from wire bytes; true if there is a good one. */
static bool decode(const uint8_t *wire, size_t count, struct host *h)
{
    static struct evlcp_link link;
    struct evlcp_datagram d;
    memset(&link, 0, sizeof link);
    link.full_block = true;
    evlcp_link_push(&link, wire, (uint32_t)count);
    if (!evlcp_link_next(&link, &d))
        return false;
    h->type = d.type;
    h->status = d.status;
    h->reply_sequence = d.sequence;
    h->length = d.length;
    memcpy(h->payload, d.payload, d.length);
    return true;
}

static bool exchange(struct host *h, uint8_t type, uint16_t sequence, uint16_t session, const uint8_t *payload,
                     uint32_t length)
{
    uint8_t wire[EVLCP_WIRE_BYTES];
    uint8_t answer[4096];
    const struct evlcp_datagram d = {
        .type = type, .sequence = sequence, .session = session, .payload = payload, .length = length};
    native_input(h->board, wire, wire_of(&d, wire));
    native_run(h->board, h->board->now);
    size_t count = native_output(h->board, answer, sizeof answer);
    return count != 0u && decode(answer, count, h) && h->type == (type | EVLCP_REPLY_BIT) &&
           h->reply_sequence == sequence;
}

static uint8_t ask(struct host *h, uint8_t type, const uint8_t *payload, uint32_t length)
{
    return exchange(h, type, ++h->sequence, h->session, payload, length) ? h->status : 0xffu;
}

static void say_hello(struct host *h, uint32_t nonce)
{
    uint8_t payload[EVLCP_HELLO_REQUEST_BYTES];
    const struct evlcp_hello_request request = {.major = EVLCP_PROTOCOL_MAJOR, .minor = EVLCP_PROTOCOL_MINOR, .nonce = nonce};
    evlcp_hello_request_put(payload, &request);
    EXPECT(exchange(h, EVLCP_TYPE_HELLO, ++h->sequence, EVLCP_NO_SESSION, payload, sizeof payload));
    EXPECT(h->status == EVLCP_STATUS_OK && h->length == EVLCP_HELLO_REPLY_BYTES);
    h->session = evlcp_hello_reply_get(h->payload).session;
}

static struct evlcp_status_reply ask_status(struct host *h)
{
    EXPECT(ask(h, EVLCP_TYPE_STATUS, NULL, 0) == EVLCP_STATUS_OK);
    return evlcp_status_reply_get(h->payload);
}

/* Write `count` bytes of a pattern into a bank; returns their CRC. */
static uint32_t fill(struct host *h, uint8_t bank, uint32_t count, uint8_t seed)
{
    uint8_t content[4096];
    uint8_t payload[EVLCP_MAX_PAYLOAD];
    for (uint32_t i = 0; i < count; i++)
        content[i] = (uint8_t)(seed + 7u * i);
    for (uint32_t at = 0; at < count; at += 500u) {
        uint32_t n = count - at < 500u ? count - at : 500u;
        payload[0] = bank;
        evlcp_put32(payload + 1, at);
        memcpy(payload + EVLCP_WRITE_REQUEST_BYTES, content + at, n);
        EXPECT(ask(h, EVLCP_TYPE_WRITE, payload, EVLCP_WRITE_REQUEST_BYTES + n) == EVLCP_STATUS_OK);
    }
    return evlcp_crc32(0u, content, count);
}

static uint8_t commit(struct host *h, uint8_t bank, uint16_t packets, uint32_t length, uint32_t crc)
{
    uint8_t payload[EVLCP_COMMIT_REQUEST_BYTES];
    struct evlcp_commit_request request = {
        .bank = bank, .format = EVLCP_FORMAT_WORDS, .packets = packets, .length = length, .crc = crc};
    memcpy(request.digest, evlcp_digest, sizeof request.digest);
    evlcp_commit_request_put(payload, &request);
    return ask(h, EVLCP_TYPE_COMMIT, payload, sizeof payload);
}

static struct native *fresh(struct host *h)
{
    static struct native board;
    native_init(&board);
    *h = (struct host){.board = &board, .sequence = 0xfff0u};
    say_hello(h, 0x12345678u);
    return &board;
}

static void run_chips(struct native *board, uint32_t chips)
{
    native_run(board, board->now + (uint64_t)chips * (NATIVE_TICK_HZ / 10000u));
}

/* ---- LED records ---- */

#define KEPT 4096u
static uint8_t kept[KEPT][NATIVE_RECORD_BYTES];
static uint32_t kept_count;

static void keep(void *context, const uint8_t record[NATIVE_RECORD_BYTES])
{
    (void)context;
    if (kept_count < KEPT)
        memcpy(kept[kept_count], record, NATIVE_RECORD_BYTES);
    kept_count++;
}

static void watch_leds(struct native *board)
{
    kept_count = 0u;
    board->record = keep;
}

/* ---- tests ---- */

static uint32_t from_hex(const char *hex, uint8_t *bytes)
{
    uint32_t count = (uint32_t)strlen(hex) / 2u;
    for (uint32_t i = 0; i < count; i++) {
        char pair[3] = {hex[2u * i], hex[2u * i + 1u], '\0'};
        bytes[i] = (uint8_t)strtoul(pair, NULL, 16);
    }
    return count;
}

/* Lines `name type status sequence session payload wire`, numbers and bytes in hex, `-` for no payload. */
static void test_wire_vectors(const char *path)
{
    static char line[8192];
    unsigned vectors = 0u;
    FILE *file = fopen(path, "r");
    EXPECT(file != NULL);
    if (file == NULL)
        return;
    while (fgets(line, sizeof line, file) != NULL) {
        static char name[64];
        static char payload_hex[2048];
        static char wire_hex[2048];
        unsigned type;
        unsigned status;
        unsigned sequence;
        unsigned session;
        if (line[0] == '#' || line[0] == '\n')
            continue;
        EXPECT(sscanf(line, "%63s %x %x %x %x %2047s %2047s", name, &type, &status, &sequence, &session,
                      payload_hex, wire_hex) == 7);
        uint8_t payload[1024];
        uint8_t wire[1024];
        uint8_t made[EVLCP_WIRE_BYTES];
        struct host h = {0};
        uint32_t length = strcmp(payload_hex, "-") == 0 ? 0u : from_hex(payload_hex, payload);
        uint32_t wire_length = from_hex(wire_hex, wire);
        const struct evlcp_datagram d = {.type = (uint8_t)type,
                                         .status = (uint8_t)status,
                                         .sequence = (uint16_t)sequence,
                                         .session = (uint16_t)session,
                                         .payload = payload,
                                         .length = length};
        EXPECT(wire_of(&d, made) == wire_length && memcmp(made, wire, wire_length) == 0);
        EXPECT(decode(wire, wire_length, &h));
        EXPECT(h.type == type && h.status == status && h.reply_sequence == sequence);
        EXPECT(h.length == length && memcmp(h.payload, payload, length) == 0);
        vectors++;
    }
    fclose(file);
    EXPECT(vectors >= 10u);
}

static void test_crc32(void)
{
    EXPECT(evlcp_crc32(0u, (const uint8_t *)"123456789", 9u) == 0xcbf43926u);
    uint32_t half = evlcp_crc32(0u, (const uint8_t *)"12345", 5u);
    EXPECT(evlcp_crc32(half, (const uint8_t *)"6789", 4u) == 0xcbf43926u);
}

static void test_link_counts_what_it_drops(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t wire[EVLCP_WIRE_BYTES];
    const struct evlcp_datagram d = {.type = EVLCP_TYPE_STATUS, .sequence = 9, .session = h.session};
    uint32_t length = wire_of(&d, wire);
    wire[3] ^= 0x40u;
    native_input(board, wire, length);
    native_input(board, (const uint8_t *)"\x05\x01\x00", 3); /* ends within a block */
    uint8_t noise[EVLCP_BODY_BYTES + 40u];
    memset(noise, 0x55, sizeof noise);
    native_input(board, noise, sizeof noise); /* too long */
    native_input(board, (const uint8_t *)"\0\0\0", 3);
    native_run(board, board->now);
    struct evlcp_status_reply s = ask_status(&h);
    EXPECT(s.crc_errors + s.framing_errors == 3u);
    EXPECT(s.crc_errors >= 1u && s.framing_errors >= 2u);
    EXPECT(s.overflow_errors == 0u);
    static uint8_t flood[EVLCP_RING_BYTES + 100u];
    memset(flood, 1, sizeof flood);
    native_input(board, flood, sizeof flood);
    native_run(board, board->now);
    native_input(board, (const uint8_t *)"\0", 1);
    EXPECT(ask_status(&h).overflow_errors == 100u);
}

static void test_sessions(void)
{
    struct host h;
    fresh(&h);
    uint16_t first = h.session;
    say_hello(&h, 0x12345678u);
    EXPECT(h.session == first);
    say_hello(&h, 0x9abcdef0u);
    EXPECT(h.session != first);
    EXPECT(exchange(&h, EVLCP_TYPE_STATUS, ++h.sequence, first, NULL, 0) && h.status == EVLCP_STATUS_NO_SESSION);
    native_reset(h.board);
    EXPECT(ask(&h, EVLCP_TYPE_STATUS, NULL, 0) == EVLCP_STATUS_NO_SESSION);
    uint8_t payload[EVLCP_HELLO_REQUEST_BYTES] = {1, 2, 3};
    EXPECT(ask(&h, EVLCP_TYPE_HELLO, payload, sizeof payload) == EVLCP_STATUS_INCOMPATIBLE);
    EXPECT(h.payload[0] == EVLCP_PROTOCOL_MAJOR && h.payload[1] == EVLCP_PROTOCOL_MINOR);
    /* A host of a later minor version may say more. */
    uint8_t more[EVLCP_HELLO_REQUEST_BYTES + 9u] = {EVLCP_PROTOCOL_MAJOR, 200u, 7u};
    EXPECT(ask(&h, EVLCP_TYPE_HELLO, more, sizeof more) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_HELLO, payload, 3) == EVLCP_STATUS_BAD_LENGTH);
    EXPECT(ask(&h, 0x7f, NULL, 0) == EVLCP_STATUS_UNKNOWN_TYPE);
}

static void test_repeated_and_stale_control(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t level[2];
    evlcp_put16(level, 30u);
    uint16_t one = ++h.sequence;
    EXPECT(exchange(&h, EVLCP_TYPE_LEVEL, one, h.session, level, 2) && h.status == EVLCP_STATUS_OK);
    evlcp_put16(level, 40u);
    uint16_t two = ++h.sequence;
    EXPECT(exchange(&h, EVLCP_TYPE_LEVEL, two, h.session, level, 2) && h.status == EVLCP_STATUS_OK);
    EXPECT(exchange(&h, EVLCP_TYPE_LEVEL, one, h.session, level, 2) && h.status == EVLCP_STATUS_STALE);
    EXPECT(exchange(&h, EVLCP_TYPE_LEVEL, two, h.session, level, 2) && h.status == EVLCP_STATUS_OK);
    EXPECT(board->core.level_ma == 40u);
    /* The sequence wraps, and many queries do not make a later control request look old. */
    for (uint32_t i = 0; i < 70000u; i++)
        (void)ask_status(&h);
    evlcp_put16(level, 50u);
    EXPECT(ask(&h, EVLCP_TYPE_LEVEL, level, 2) == EVLCP_STATUS_OK && board->core.level_ma == 50u);
    evlcp_put16(level, 61u);
    EXPECT(ask(&h, EVLCP_TYPE_LEVEL, level, 2) == EVLCP_STATUS_OUT_OF_RANGE && evlcp_get32(h.payload) == 60u);
    EXPECT(board->core.level_ma == 50u);
    board->level_fails = true;
    evlcp_put16(level, 10u);
    EXPECT(ask(&h, EVLCP_TYPE_LEVEL, level, 2) == EVLCP_STATUS_HARDWARE_FAULT && board->core.level_ma == 50u);
}

static void test_dark_until_commit_and_start(void)
{
    struct host h;
    struct native *board = fresh(&h);
    watch_leds(board);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_NOTHING_COMMITTED);
    run_chips(board, 100u);
    EXPECT(kept_count == 0u);
    uint32_t crc = fill(&h, 0, 640u, 1);
    EXPECT(commit(&h, 0, 2, 640u, crc ^ 1u) == EVLCP_STATUS_BAD_CRC && evlcp_get32(h.payload) == crc);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_NOTHING_COMMITTED);
    EXPECT(commit(&h, 0, 3, 640u, crc) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(commit(&h, 0, 2, 640u, crc) == EVLCP_STATUS_OK);
    EXPECT(commit(&h, 0, 2, 640u, crc) == EVLCP_STATUS_OK); /* idempotent */
    EXPECT(board->core.banks.commits == 1u);
    run_chips(board, 100u);
    EXPECT(kept_count == 0u);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 100u);
    EXPECT(kept_count == 100u);
    EXPECT(evlcp_get32(kept[0] + 4) == 0u && evlcp_get32(kept[99] + 4) == 99u);
    /* Chip 0 of the preamble is dark, chip 1 lit: values are sent as (-b, +b). */
    EXPECT(kept[0][8] == 0u && kept[1][8] == 0xffu);
}

static void test_stop_and_blank(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint32_t crc = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 40u);
    watch_leds(board);
    EXPECT(ask(&h, EVLCP_TYPE_STOP, NULL, 0) == EVLCP_STATUS_OK);
    EXPECT(ask_status(&h).state == EVLCP_STATE_STOPPING);
    run_chips(board, 1000u);
    EXPECT(kept_count == 346u - 40u + 1u); /* the rest of the packet, then dark */
    EXPECT(evlcp_get32(kept[kept_count - 1u] + 4) == EVLCP_CHIP_DARK);
    EXPECT(ask_status(&h).state == EVLCP_STATE_DARK);
    EXPECT(ask_status(&h).packets_sent == 1u);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 100u);
    watch_leds(board);
    EXPECT(ask(&h, EVLCP_TYPE_BLANK, NULL, 0) == EVLCP_STATUS_OK);
    EXPECT(kept_count == 1u && evlcp_get32(kept[0] + 4) == EVLCP_CHIP_DARK);
    run_chips(board, 1000u);
    EXPECT(kept_count == 1u);
    /* A START that comes while it stops plays on. */
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    EXPECT(ask(&h, EVLCP_TYPE_STOP, NULL, 0) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 1000u);
    EXPECT(ask_status(&h).state == EVLCP_STATE_PLAYING);
}

static void test_banks_are_held(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t write[EVLCP_WRITE_REQUEST_BYTES + 1u] = {0};
    uint32_t crc = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_WRITE, write, sizeof write) == EVLCP_STATUS_BUSY);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    uint32_t other = fill(&h, 1, 320u, 9);
    EXPECT(commit(&h, 1, 1, 320u, other ^ 1u) == EVLCP_STATUS_BAD_CRC);
    EXPECT(ask_status(&h).pending_bank == EVLCP_NO_BANK && ask_status(&h).active_bank == 0u);
    EXPECT(commit(&h, 1, 1, 320u, other) == EVLCP_STATUS_OK);
    EXPECT(ask_status(&h).pending_bank == 1u && ask_status(&h).active_bank == 0u);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_BUSY); /* bank 1 waits */
    EXPECT(commit(&h, 1, 1, 320u, other) == EVLCP_STATUS_OK); /* idempotent */
    write[0] = 1u;
    EXPECT(ask(&h, EVLCP_TYPE_WRITE, write, sizeof write) == EVLCP_STATUS_BUSY);
    run_chips(board, 346u);
    EXPECT(ask_status(&h).active_bank == 1u && ask_status(&h).pending_bank == EVLCP_NO_BANK);
    write[0] = 2u;
    EXPECT(ask(&h, EVLCP_TYPE_WRITE, write, sizeof write) == EVLCP_STATUS_OUT_OF_RANGE);
    write[0] = 0u;
    evlcp_put32(write + 1, EVLCP_BANK_BYTES);
    EXPECT(ask(&h, EVLCP_TYPE_WRITE, write, sizeof write) == EVLCP_STATUS_OUT_OF_RANGE);
    evlcp_put32(write + 1, 0xffffffffu);
    EXPECT(ask(&h, EVLCP_TYPE_WRITE, write, sizeof write) == EVLCP_STATUS_OUT_OF_RANGE);
}

static void test_foreign_codebook_never_plays(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t payload[EVLCP_COMMIT_REQUEST_BYTES];
    struct evlcp_commit_request request = {.bank = 0, .format = EVLCP_FORMAT_WORDS, .packets = 1, .length = 320};
    request.crc = fill(&h, 0, 320u, 3);
    memcpy(request.digest, evlcp_profile_digests[EVLCP_PROFILE_WH8], 32u);
    evlcp_commit_request_put(payload, &request);
    EXPECT(ask(&h, EVLCP_TYPE_COMMIT, payload, sizeof payload) == EVLCP_STATUS_FOREIGN_CODEBOOK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_NOTHING_COMMITTED);

    uint8_t code[EVLCP_CODEBOOK_REQUEST_BYTES];
    struct evlcp_codebook_request book = {.preamble_chips = EVLCP_PREAMBLE_CHIPS, .preamble = evlcp_preamble};
    memcpy(book.pilots, evlcp_pilots, sizeof book.pilots);
    memcpy(book.digest, evlcp_digest, sizeof book.digest);
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_OK);
    book.pilots[3] ^= 1u;
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_FOREIGN_CODEBOOK);
    book.pilots[3] ^= 1u;
    book.digest[0] ^= 1u;
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_FOREIGN_CODEBOOK);
    book.preamble_chips = 33u;
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_OUT_OF_RANGE);

    /* A codebook of one's own, under its own profile, plays its own preamble and pilots. */
    uint8_t configure[EVLCP_CONFIGURE_REQUEST_BYTES];
    const struct evlcp_configure_request own = {.chip_rate_hz = 10000, .profile = EVLCP_PROFILE_CUSTOM, .frames = 10, .pilot_every = 1};
    evlcp_configure_request_put(configure, &own);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, configure, sizeof configure) == EVLCP_STATUS_OK);
    book.preamble_chips = 2u;
    book.preamble = 2u;
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_OK);
    memcpy(request.digest, book.digest, 32u);
    evlcp_commit_request_put(payload, &request);
    EXPECT(ask(&h, EVLCP_TYPE_COMMIT, payload, sizeof payload) == EVLCP_STATUS_OK);
    /* A digest of one's own vouches for nothing: other pilots or another preamble are not there already. */
    book.pilots[3] ^= 2u;
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_COMMIT, payload, sizeof payload) == EVLCP_STATUS_BUSY);
    book.pilots[3] ^= 2u;
    book.preamble = 1u;
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_COMMIT, payload, sizeof payload) == EVLCP_STATUS_BUSY);
    book.preamble = 2u;
    evlcp_codebook_request_put(code, &book);
    EXPECT(ask(&h, EVLCP_TYPE_CODEBOOK, code, sizeof code) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_COMMIT, payload, sizeof payload) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    watch_leds(board);
    run_chips(board, 3u);
    EXPECT(kept[0][8] == 0xffu && kept[1][8] == 0u);
}

static void test_configure_limits(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t payload[EVLCP_CONFIGURE_REQUEST_BYTES];
    struct evlcp_configure_request r = {.chip_rate_hz = 3000, .profile = 0, .frames = 10, .pilot_every = 1};
    evlcp_configure_request_put(payload, &r); /* 3 kHz does not divide the ticks */
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
    /* The nearest of the products of powers of 2 and 5 up to 20000: 10 MHz is 2^7 5^7. */
    static const uint32_t nearest[][2] = {{3000u, 3125u},   {7777u, 8000u},        {7125u, 6250u},
                                          {0u, 1u},         {3u, 2u},              {18001u, 20000u},
                                          {20001u, 20000u}, {4294967295u, 20000u}, {18000u, 16000u}};
    for (uint32_t i = 0; i < sizeof nearest / sizeof nearest[0]; i++) {
        r.chip_rate_hz = nearest[i][0];
        evlcp_configure_request_put(payload, &r);
        EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
        EXPECT(evlcp_get32(h.payload) == nearest[i][1]);
    }
    r.chip_rate_hz = 20000;
    r.frames = 0;
    evlcp_configure_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(evlcp_get32(h.payload) == 1u);
    r.frames = 65535;
    evlcp_configure_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(evlcp_get32(h.payload) == EVLCP_BANK_BYTES / EVLCP_FRAME_BYTES);
    r.frames = 10;
    r.profile = 9;
    evlcp_configure_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
    r.profile = EVLCP_PROFILE_WH4X2;
    r.pilot_every = 0;
    evlcp_configure_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(evlcp_get32(h.payload) == 1u);
    r.pilot_every = 1;
    evlcp_configure_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OK);
    EXPECT(evlcp_get32(h.payload) == NATIVE_TICK_HZ / 20000u && evlcp_get32(h.payload + 4) == 346u);
    /* Another chip rate is not taken over while it plays. */
    uint32_t crc = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    r.chip_rate_hz = 10000;
    evlcp_configure_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OK);
    crc = fill(&h, 1, 320u, 2);
    EXPECT(commit(&h, 1, 1, 320u, crc) == EVLCP_STATUS_BUSY && evlcp_get32(h.payload) == 20000u);
}

static void test_watchdog(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t payload[EVLCP_WATCHDOG_REQUEST_BYTES];
    struct evlcp_watchdog_request r = {.action = EVLCP_WATCHDOG_IDLE, .timeout_ms = 99};
    evlcp_watchdog_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_WATCHDOG, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
    r.timeout_ms = 100;
    evlcp_watchdog_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_WATCHDOG, payload, sizeof payload) == EVLCP_STATUS_OK);
    uint32_t crc = fill(&h, 0, 640u, 1);
    EXPECT(commit(&h, 0, 2, 640u, crc) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    watch_leds(board);
    run_chips(board, 900u);
    EXPECT(ask_status(&h).faults == 0u);
    run_chips(board, 3000u);
    /* Silent since chip 900, it acts after chip 1900, at the end of the packet: from chip 2076 on every chip is
       the opposite of the last. */
    uint32_t alternate = 0u;
    for (uint32_t i = 2077u; i < 3077u; i++)
        alternate += kept[i][8] != kept[i - 1u][8] && (kept[i][8] == 0u || kept[i][8] == 0xffu) &&
                     kept[i][8] == kept[i][19];
    EXPECT(alternate == 1000u);
    struct evlcp_status_reply s = ask_status(&h);
    EXPECT(s.faults == EVLCP_FAULT_WATCHDOG && s.state == EVLCP_STATE_IDLE_PATTERN);
    EXPECT(s.silence_ms >= 90u);
    run_chips(board, 400u);
    s = ask_status(&h);
    EXPECT(s.faults == EVLCP_FAULT_WATCHDOG && s.state == EVLCP_STATE_PLAYING);

    r.action = EVLCP_WATCHDOG_DARK;
    evlcp_watchdog_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_WATCHDOG, payload, sizeof payload) == EVLCP_STATUS_OK);
    EXPECT(ask_status(&h).faults == 0u);
    run_chips(board, 3000u);
    /* A host that comes back says HELLO first. */
    say_hello(&h, 0x5a5a5a5au);
    run_chips(board, 100u);
    s = ask_status(&h);
    EXPECT(s.state == EVLCP_STATE_DARK && s.faults == EVLCP_FAULT_WATCHDOG);
    EXPECT(s.silence_ms >= 310u && s.silence_ms < 320u);
    s = ask_status(&h);
    EXPECT(s.faults == EVLCP_FAULT_WATCHDOG && s.silence_ms == 0u);
    run_chips(board, 500u);
    EXPECT(ask_status(&h).state == EVLCP_STATE_DARK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    EXPECT(ask_status(&h).state == EVLCP_STATE_PLAYING);
}

static void test_faults_darken(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint32_t crc = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 100u);
    board->health.faults = EVLCP_FAULT_OPEN_LED;
    board->health.open_leds[0] = 0x80u;
    run_chips(board, 1100u);
    struct evlcp_status_reply s = ask_status(&h);
    EXPECT(s.state == EVLCP_STATE_PLAYING && s.faults == EVLCP_FAULT_OPEN_LED && s.open_leds[0] == 0x80u);
    board->health.faults = EVLCP_FAULT_OVER_TEMPERATURE;
    board->health.temperature_dc = 1200;
    watch_leds(board);
    run_chips(board, 1100u);
    s = ask_status(&h);
    EXPECT(s.state == EVLCP_STATE_FAULT && s.temperature_dc == 1200);
    EXPECT(kept_count > 0u && kept_count < 1100u);
    EXPECT(evlcp_get32(kept[kept_count - 1u] + 4) == EVLCP_CHIP_DARK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_HARDWARE_FAULT);
    board->health.faults = 0u;
    run_chips(board, 1100u);
    EXPECT(ask_status(&h).state == EVLCP_STATE_FAULT); /* dark until START */
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    s = ask_status(&h);
    EXPECT(s.state == EVLCP_STATE_PLAYING && s.faults == 0u);
    /* A chip that comes a whole chip late ends in the dark. */
    board->late = 999u;
    run_chips(board, 2u);
    s = ask_status(&h);
    EXPECT(s.state == EVLCP_STATE_PLAYING && s.lateness_ticks == 999u && s.lateness_max_ticks == 999u);
    board->late = 1000u;
    run_chips(board, 2u);
    s = ask_status(&h);
    EXPECT(s.state == EVLCP_STATE_FAULT && (s.faults & EVLCP_FAULT_CHIP_LOST) != 0u);
    board->late = 0u;
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    EXPECT(ask_status(&h).state == EVLCP_STATE_PLAYING);
}

static bool is_dark(const struct native *board)
{
    static const uint8_t none[EVLCP_ROW_BYTES];
    return memcmp(board->shown, none, sizeof none) == 0;
}

static void test_hardware_that_fails_darkens(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint32_t crc = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_OK);
    for (uint32_t stopping = 0; stopping < 2u; stopping++) {
        EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
        run_chips(board, 10u);
        if (stopping != 0u) {
            EXPECT(ask(&h, EVLCP_TYPE_STOP, NULL, 0) == EVLCP_STATUS_OK);
            EXPECT(ask_status(&h).state == EVLCP_STATE_STOPPING);
        }
        evlcp_failed(&board->core);
        EXPECT(is_dark(board) && board->period == 0u);
        struct evlcp_status_reply s = ask_status(&h);
        EXPECT(s.state == EVLCP_STATE_FAULT && s.faults == EVLCP_FAULT_CHIP_LOST);
        EXPECT(ask(&h, EVLCP_TYPE_STOP, NULL, 0) == EVLCP_STATUS_OK);
        run_chips(board, 10u);
        EXPECT(is_dark(board) && ask_status(&h).state == EVLCP_STATE_FAULT);
    }
    /* What the health says is the fault's name. */
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    board->health.faults = EVLCP_FAULT_CLOCK;
    evlcp_failed(&board->core);
    struct evlcp_status_reply s = ask_status(&h);
    EXPECT(is_dark(board) && s.state == EVLCP_STATE_FAULT && s.faults == EVLCP_FAULT_CLOCK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_HARDWARE_FAULT);
    board->health.faults = 0u;
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    run_chips(board, 10u);
    EXPECT(ask_status(&h).state == EVLCP_STATE_PLAYING);
    /* It ends a LED test as well. */
    EXPECT(ask(&h, EVLCP_TYPE_BLANK, NULL, 0) == EVLCP_STATUS_OK);
    const uint8_t walk[] = {5u, 5u, 100u, 0u};
    EXPECT(ask(&h, EVLCP_TYPE_LED_TEST, walk, sizeof walk) == EVLCP_STATUS_OK && !is_dark(board));
    evlcp_failed(&board->core);
    EXPECT(is_dark(board) && ask_status(&h).state == EVLCP_STATE_FAULT);
}

static void test_save_and_recall(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t autostart = 0u;
    EXPECT(ask(&h, EVLCP_TYPE_RECALL, NULL, 0) == EVLCP_STATUS_EMPTY_SLOT);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_NOTHING_COMMITTED);
    uint32_t first = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, first) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_OK && h.payload[0] == 0u);
    uint32_t second = fill(&h, 1, 640u, 2);
    EXPECT(commit(&h, 1, 2, 640u, second) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_OK && h.payload[0] == 1u);
    EXPECT(evlcp_get32(h.payload + 1) == 2u);
    native_reset(board);
    say_hello(&h, 1u);
    EXPECT(ask_status(&h).active_bank == EVLCP_NO_BANK);
    EXPECT(ask(&h, EVLCP_TYPE_RECALL, NULL, 0) == EVLCP_STATUS_OK && h.payload[0] == 1u);
    EXPECT(ask_status(&h).crc == second);
    /* Damage to the newest slot leaves the older one. */
    board->flash[1][EVLCP_SLOT_HEADER_BYTES + 5u] ^= 1u;
    native_reset(board);
    say_hello(&h, 2u);
    EXPECT(ask(&h, EVLCP_TYPE_RECALL, NULL, 0) == EVLCP_STATUS_OK && h.payload[0] == 0u);
    EXPECT(ask_status(&h).crc == first);
    /* The next SAVE goes into the slot that is not the newest valid header. */
    autostart = 1u;
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_OK && h.payload[0] == 0u);
    native_reset(board); /* starts to play by itself */
    watch_leds(board);
    run_chips(board, 50u);
    EXPECT(kept_count == 50u);
    say_hello(&h, 3u);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_BUSY);
    EXPECT(ask(&h, EVLCP_TYPE_BLANK, NULL, 0) == EVLCP_STATUS_OK);
    board->flash_fails = true;
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_FLASH_FAULT);
}

/* A whole slot of the layout before pilot_every is empty to this firmware; this layout keeps pilot_every. */
static void test_slot_of_older_firmware(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t autostart = 0u;
    uint8_t payload[EVLCP_CONFIGURE_REQUEST_BYTES];
    const struct evlcp_configure_request r = {.chip_rate_hz = 10000, .profile = 0, .frames = 10, .pilot_every = 4};
    evlcp_configure_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OK);
    uint32_t crc = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_OK && h.payload[0] == 0u);
    native_reset(board);
    say_hello(&h, 1u);
    EXPECT(ask(&h, EVLCP_TYPE_RECALL, NULL, 0) == EVLCP_STATUS_OK);
    EXPECT(ask_status(&h).pilot_every == 4u);
    uint8_t *header = board->flash[0];
    evlcp_put32(header, 0x45564c31u);
    header[19] = 0u;
    evlcp_put32(header + EVLCP_SLOT_HEADER_BYTES - 4u, evlcp_crc32(0u, header, EVLCP_SLOT_HEADER_BYTES - 4u));
    native_reset(board);
    say_hello(&h, 2u);
    EXPECT(ask(&h, EVLCP_TYPE_RECALL, NULL, 0) == EVLCP_STATUS_EMPTY_SLOT);
    EXPECT(ask_status(&h).active_bank == EVLCP_NO_BANK);
}

static void test_led_test(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t payload[EVLCP_LED_TEST_REQUEST_BYTES];
    struct evlcp_led_test_request r = {.first = 0, .last = 95, .dwell_ms = 2};
    evlcp_led_test_request_put(payload, &r);
    watch_leds(board);
    EXPECT(ask(&h, EVLCP_TYPE_LED_TEST, payload, sizeof payload) == EVLCP_STATUS_OK);
    for (uint32_t ms = 0; ms < 200u; ms++)
        native_run(board, board->now + NATIVE_TICK_HZ / 1000u);
    EXPECT(kept_count == 97u);
    uint32_t right = 0u;
    for (uint32_t led = 0; led < 96u; led++) {
        uint8_t row[EVLCP_ROW_BYTES] = {0};
        row[led / 8u] = (uint8_t)(0x80u >> led % 8u);
        right += memcmp(kept[led] + 8, row, sizeof row) == 0 && evlcp_get32(kept[led] + 4) == EVLCP_CHIP_TEST;
    }
    EXPECT(right == 96u);
    EXPECT(evlcp_get32(kept[96] + 4) == EVLCP_CHIP_DARK);
    EXPECT(ask_status(&h).state == EVLCP_STATE_DARK);
    r.last = 96;
    evlcp_led_test_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_LED_TEST, payload, sizeof payload) == EVLCP_STATUS_OUT_OF_RANGE);
    /* Flash waits until the LEDs are dark. */
    uint8_t autostart = 0u;
    uint32_t crc = fill(&h, 0, 320u, 1);
    EXPECT(commit(&h, 0, 1, 320u, crc) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_OK);
    r.last = 95;
    evlcp_led_test_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_LED_TEST, payload, sizeof payload) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_BUSY);
    EXPECT(ask(&h, EVLCP_TYPE_RECALL, NULL, 0) == EVLCP_STATUS_BUSY);
    EXPECT(ask(&h, EVLCP_TYPE_STOP, NULL, 0) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, &autostart, 1) == EVLCP_STATUS_OK);
}

static void test_masks(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t write[EVLCP_MAX_PAYLOAD];
    uint8_t content[346u * EVLCP_ROW_BYTES];
    for (uint32_t i = 0; i < sizeof content; i++)
        content[i] = (uint8_t)(i * 31u + i / 12u);
    for (uint32_t at = 0; at < sizeof content; at += 500u) {
        uint32_t n = sizeof content - at < 500u ? (uint32_t)sizeof content - at : 500u;
        write[0] = 0u;
        evlcp_put32(write + 1, at);
        memcpy(write + EVLCP_WRITE_REQUEST_BYTES, content + at, n);
        EXPECT(ask(&h, EVLCP_TYPE_WRITE, write, EVLCP_WRITE_REQUEST_BYTES + n) == EVLCP_STATUS_OK);
    }
    uint8_t payload[EVLCP_COMMIT_REQUEST_BYTES];
    struct evlcp_commit_request r = {.format = EVLCP_FORMAT_MASKS, .packets = 1, .length = sizeof content};
    r.crc = evlcp_crc32(0u, content, sizeof content);
    memcpy(r.digest, evlcp_digest, sizeof r.digest);
    evlcp_commit_request_put(payload, &r);
    EXPECT(ask(&h, EVLCP_TYPE_COMMIT, payload, sizeof payload) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    watch_leds(board);
    run_chips(board, 700u);
    uint32_t same = 0u;
    for (uint32_t i = 0; i < 700u; i++)
        same += memcmp(kept[i] + 8, content + (i % 346u) * EVLCP_ROW_BYTES, EVLCP_ROW_BYTES) == 0;
    EXPECT(same == 700u);
}

/* The row of a chip of a frame: pilots for its first 16 chips, info words after. */
static void expected_row(const uint8_t *words, uint32_t chip, uint8_t row[EVLCP_ROW_BYTES])
{
    uint32_t mask = 0u;
    for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++) {
        uint32_t word = chip < 16u ? evlcp_pilots[k] : evlcp_get16(words + 2u * k);
        mask = mask << 1 | (word >> (15u - chip % 16u) & 1u);
    }
    evlcp_row_of_mask((uint16_t)mask, row);
}

/* Frames 0, N, ... of every packet have a pilot, the others are their info words alone. */
static uint8_t set_chips(struct host *h, uint32_t packet_chips, uint8_t hold, uint8_t clusters)
{
    uint8_t payload[EVLCP_CHIPS_REQUEST_BYTES];
    const struct evlcp_chips_request request = {
        .packet_chips = packet_chips, .hold = hold, .clusters = clusters, .digest = {7u}};
    evlcp_chips_request_put(payload, &request);
    return ask(h, EVLCP_TYPE_CHIPS, payload, sizeof payload);
}

static uint8_t commit_chips(struct host *h, uint8_t bank, uint8_t format, uint16_t packets, const uint8_t *content,
                            uint32_t length)
{
    uint8_t payload[EVLCP_MAX_PAYLOAD];
    payload[0] = bank;
    evlcp_put32(payload + 1, 0u);
    memcpy(payload + EVLCP_WRITE_REQUEST_BYTES, content, length);
    EXPECT(ask(h, EVLCP_TYPE_WRITE, payload, EVLCP_WRITE_REQUEST_BYTES + length) == EVLCP_STATUS_OK);
    const struct evlcp_commit_request request = {.bank = bank,
                                                 .format = format,
                                                 .packets = packets,
                                                 .length = length,
                                                 .crc = evlcp_crc32(0u, content, length),
                                                 .digest = {7u}};
    evlcp_commit_request_put(payload, &request);
    return ask(h, EVLCP_TYPE_COMMIT, payload, EVLCP_COMMIT_REQUEST_BYTES);
}

static void test_chips_of_clusters(void)
{
    struct host h;
    struct native *board = fresh(&h);
    /* Two clusters, LEDs 0 and 1 and LED 95; three chips: the first, none, both, the last with bits of no cluster. */
    uint8_t content[2u * EVLCP_ROW_BYTES + 3u] = {0};
    content[0] = 0xc0u;
    content[2u * EVLCP_ROW_BYTES - 1u] = 0x01u;
    content[24] = 0x80u;
    content[26] = 0xffu;
    EXPECT(set_chips(&h, 0u, 1u, 2u) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(set_chips(&h, 3u, 0u, 2u) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(set_chips(&h, 3u, 1u, EVLCP_LEDS + 1u) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(set_chips(&h, EVLCP_BANK_BYTES + 1u, 1u, 2u) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(set_chips(&h, 3u, 2u, 2u) == EVLCP_STATUS_OK);
    EXPECT(commit_chips(&h, 0u, EVLCP_FORMAT_WORDS, 1u, content, sizeof content) == EVLCP_STATUS_OUT_OF_RANGE);
    content[EVLCP_ROW_BYTES] = 0x40u; /* LED 1 once more */
    EXPECT(commit_chips(&h, 0u, EVLCP_FORMAT_CLUSTERS, 1u, content, sizeof content) == EVLCP_STATUS_OUT_OF_RANGE);
    EXPECT(evlcp_get32(h.payload) == 1u);
    content[EVLCP_ROW_BYTES] = 0u;
    EXPECT(commit_chips(&h, 0u, EVLCP_FORMAT_CLUSTERS, 1u, content, sizeof content) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    watch_leds(board);
    run_chips(board, 12u);
    static const uint8_t first[6] = {0xc0u, 0xc0u, 0u, 0u, 0xc0u, 0xc0u};
    static const uint8_t last[6] = {0u, 0u, 0u, 0u, 1u, 1u};
    EXPECT(kept_count == 12u);
    for (uint32_t n = 0; n < 12u; n++) {
        EXPECT(kept[n][8] == first[n % 6u] && kept[n][19] == last[n % 6u]);
        for (uint32_t i = 9u; i < 19u; i++)
            EXPECT(kept[n][i] == 0u);
    }
    const struct evlcp_status_reply s = ask_status(&h);
    EXPECT(s.packet_chips == 6u && s.hold == 2u && s.clusters == 2u && s.duty == 667u);
    EXPECT(s.packets_sent == 2u && s.profile == EVLCP_PROFILE_CUSTOM);
    /* A slot keeps it, and its header has neither frames nor a preamble. */
    EXPECT(ask(&h, EVLCP_TYPE_BLANK, NULL, 0) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_SAVE, (const uint8_t *)"\0", 1) == EVLCP_STATUS_OK);
    native_reset(board);
    say_hello(&h, 5u);
    EXPECT(ask(&h, EVLCP_TYPE_RECALL, NULL, 0) == EVLCP_STATUS_OK);
    EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
    watch_leds(board);
    run_chips(board, 6u);
    for (uint32_t n = 0; n < 6u; n++)
        EXPECT(kept[n][8] == first[n] && kept[n][19] == last[n]);
    EXPECT(ask_status(&h).hold == 2u && ask_status(&h).packet_chips == 6u);
}

static void test_sparse_pilots(void)
{
    static const uint8_t every[] = {1u, 2u, 4u, 7u, 255u};
    const uint32_t frames = 7u;
    for (uint32_t n = 0; n < sizeof every; n++) {
        struct host h;
        struct native *board = fresh(&h);
        uint8_t payload[EVLCP_CONFIGURE_REQUEST_BYTES];
        const struct evlcp_configure_request r = {
            .chip_rate_hz = 10000, .profile = 0, .frames = (uint16_t)frames, .pilot_every = every[n]};
        evlcp_configure_request_put(payload, &r);
        EXPECT(ask(&h, EVLCP_TYPE_CONFIGURE, payload, sizeof payload) == EVLCP_STATUS_OK);
        uint32_t chips = EVLCP_PREAMBLE_CHIPS;
        for (uint32_t f = 0; f < frames; f++)
            chips += f % every[n] == 0u ? 32u : 16u;
        EXPECT(evlcp_get32(h.payload + 4) == chips);
        uint32_t length = 2u * frames * 32u;
        uint32_t crc = fill(&h, 0, length, 3);
        EXPECT(commit(&h, 0, 2, length, crc) == EVLCP_STATUS_OK);
        EXPECT(ask(&h, EVLCP_TYPE_START, NULL, 0) == EVLCP_STATUS_OK);
        watch_leds(board);
        run_chips(board, 2u * chips + 30u);
        const uint8_t *content = board->core.banks.content[0];
        uint32_t at = 0u;
        uint32_t same = 0u;
        for (uint32_t packet = 0; packet < 2u; packet++) {
            at += EVLCP_PREAMBLE_CHIPS;
            for (uint32_t f = 0; f < frames; f++) {
                for (uint32_t chip = f % every[n] == 0u ? 0u : 16u; chip < 32u; chip++, at++) {
                    uint8_t row[EVLCP_ROW_BYTES];
                    expected_row(content + (packet * frames + f) * 32u, chip, row);
                    same += memcmp(kept[at] + 8, row, EVLCP_ROW_BYTES) == 0;
                }
            }
        }
        EXPECT(at == 2u * chips && same == 2u * (chips - EVLCP_PREAMBLE_CHIPS));
        /* Then the first packet starts anew, with its preamble. */
        uint32_t preamble = 0u;
        for (uint32_t chip = 0; chip < EVLCP_PREAMBLE_CHIPS; chip++)
            preamble = preamble << 1 | (kept[at + chip][8] == 0xffu);
        EXPECT(preamble == evlcp_preamble);
    }
}

static uint32_t random_state = 0x2545f491u;

static uint32_t next_random(void)
{
    random_state ^= random_state << 13;
    random_state ^= random_state >> 17;
    random_state ^= random_state << 5;
    return random_state;
}

static void test_random_strings(void)
{
    struct host h;
    struct native *board = fresh(&h);
    uint8_t bytes[1500];
    uint8_t wire[EVLCP_WIRE_BYTES];
    for (uint32_t i = 0; i < 10000u; i++) {
        uint32_t length = next_random() % sizeof bytes;
        for (uint32_t k = 0; k < length; k++)
            bytes[k] = (uint8_t)(next_random() >> 9);
        native_input(board, bytes, length);
        /* And well-formed datagrams of random content, which reach further. */
        uint8_t type = (uint8_t)(next_random() % 24u);
        const struct evlcp_datagram d = {.type = type == 0u ? (uint8_t)EVLCP_TYPE_CHIPS : type,
                                         .sequence = (uint16_t)(h.sequence + i),
                                         .session = h.session,
                                         .payload = bytes,
                                         .length = next_random() % (EVLCP_MAX_PAYLOAD + 1u)};
        native_input(board, (const uint8_t *)"\0", 1);
        native_input(board, wire, wire_of(&d, wire));
        run_chips(board, 1u);
        board->output_length = 0u;
    }
    EXPECT(board->core.requests >= 10000u);
    native_input(board, (const uint8_t *)"\0", 1);
    native_run(board, board->now);
    board->output_length = 0u;
    say_hello(&h, 77u);
    EXPECT(ask_status(&h).requests > 10000u);
}

int main(int argc, char **argv)
{
    test_crc32();
    if (argc > 1)
        test_wire_vectors(argv[1]);
    test_link_counts_what_it_drops();
    test_sessions();
    test_repeated_and_stale_control();
    test_dark_until_commit_and_start();
    test_stop_and_blank();
    test_banks_are_held();
    test_foreign_codebook_never_plays();
    test_configure_limits();
    test_watchdog();
    test_faults_darken();
    test_hardware_that_fails_darkens();
    test_save_and_recall();
    test_slot_of_older_firmware();
    test_led_test();
    test_masks();
    test_chips_of_clusters();
    test_sparse_pilots();
    test_random_strings();
    printf("%u passed, %u failed\n", passed, failed);
    return failed != 0u;
}
