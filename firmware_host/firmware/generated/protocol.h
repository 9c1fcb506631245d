/* Messages of the driver board; generated from protocol.toml, do not edit. */
#pragma once
#include <stdint.h>

#define EVLCP_PROTOCOL_MAJOR 2u
#define EVLCP_PROTOCOL_MINOR 2u
#define EVLCP_HEADER_BYTES 6u
#define EVLCP_CRC_BYTES 4u
#define EVLCP_MAX_PAYLOAD 512u
#define EVLCP_WINDOW 6u
#define EVLCP_BAUD 1000000u
#define EVLCP_BOARD_CLUSTERS 16u
#define EVLCP_LEDS 96u
#define EVLCP_ROW_BYTES 12u
#define EVLCP_REPLY_BIT 0x80u /* Set in the type of a reply. */
#define EVLCP_NO_BANK 0xffu /* No bank. */
#define EVLCP_NO_SESSION 0x0u /* Session of a HELLO request, and of a board that knows no host. */
#define EVLCP_SEALED 0x1u /* Status of a request that ends with a seal. */
#define EVLCP_SEAL_BYTES 0x10u /* Length of a seal, at the end of the payload. */
#define EVLCP_KEY_BYTES 0x10u /* Length of a board's key. */
#define EVLCP_CHALLENGE_BYTES 0x8u /* Length of a session's challenge. */
#define EVLCP_KEY_NAME_BYTES 0x4u /* First bytes of a key's SHA-256, which name it. */
#define EVLCP_CHIP_DARK 0xffffffffu /* Chip number in an LED record: output is dark, no chip. */
#define EVLCP_CHIP_TEST 0xfffffffeu /* Chip number in an LED record: single-LED test, no chip. */

enum evlcp_type {
    EVLCP_TYPE_HELLO = 0x01,
    EVLCP_TYPE_CONFIGURE = 0x02,
    EVLCP_TYPE_CODEBOOK = 0x03,
    EVLCP_TYPE_WRITE = 0x04,
    EVLCP_TYPE_READ = 0x05,
    EVLCP_TYPE_CRC = 0x06,
    EVLCP_TYPE_COMMIT = 0x07,
    EVLCP_TYPE_START = 0x08,
    EVLCP_TYPE_STOP = 0x09,
    EVLCP_TYPE_BLANK = 0x0a,
    EVLCP_TYPE_LEVEL = 0x0b,
    EVLCP_TYPE_STATUS = 0x0c,
    EVLCP_TYPE_WATCHDOG = 0x0d,
    EVLCP_TYPE_SAVE = 0x0e,
    EVLCP_TYPE_RECALL = 0x0f,
    EVLCP_TYPE_LED_TEST = 0x10,
    EVLCP_TYPE_STREAM = 0x18,
    EVLCP_TYPE_PUSH = 0x19,
    EVLCP_TYPE_KEY = 0x1a,
    EVLCP_TYPE_CHIPS = 0x1b,
    EVLCP_TYPE_UPDATE_STATUS = 0x20,
    EVLCP_TYPE_UPDATE_BEGIN = 0x21,
    EVLCP_TYPE_UPDATE_WRITE = 0x22,
    EVLCP_TYPE_UPDATE_COMMIT = 0x23,
    EVLCP_TYPE_UPDATE_RESTART = 0x24,
    EVLCP_TYPE_UPDATE_CONFIRM = 0x25,
};

/* How a request ended. */
enum evlcp_status {
    EVLCP_STATUS_OK = 0, /* Done. */
    EVLCP_STATUS_UNKNOWN_TYPE = 1, /* The board does not know this request. */
    EVLCP_STATUS_BAD_LENGTH = 2, /* The payload has another length than the request's; detail: expected length. */
    EVLCP_STATUS_OUT_OF_RANGE = 3, /* A value the board cannot take; detail: the nearest value it can. */
    EVLCP_STATUS_BUSY = 4, /* Not while playing or, for flash, in a LED test; or the bank is playing or about to. */
    EVLCP_STATUS_BAD_CRC = 5, /* The bank's content has another CRC; detail: the CRC found. */
    EVLCP_STATUS_FOREIGN_CODEBOOK = 6, /* The codebook's digest is not the one that belongs here. */
    EVLCP_STATUS_NO_SESSION = 7, /* The board was reset, or another host has said HELLO. */
    EVLCP_STATUS_STALE = 8, /* Older than a request already done; not done. */
    EVLCP_STATUS_NOTHING_COMMITTED = 9, /* No bank has been committed. */
    EVLCP_STATUS_INCOMPATIBLE = 10, /* The host's major version is another one. */
    EVLCP_STATUS_FLASH_FAULT = 11, /* The flash did not take or give the data. */
    EVLCP_STATUS_NOT_SUPPORTED = 12, /* This board cannot do that. */
    EVLCP_STATUS_EMPTY_SLOT = 13, /* No flash slot holds a valid setting. */
    EVLCP_STATUS_HARDWARE_FAULT = 14, /* A fault holds the LEDs dark; detail: fault bits. */
    EVLCP_STATUS_NEEDS_KEY = 16, /* The board has a key: what changes something must be sealed with it. */
    EVLCP_STATUS_BAD_SEAL = 17, /* The seal is of another key, or of another request. */
    EVLCP_STATUS_TOO_BRIGHT = 15, /* LEDs would be on for longer than the limits allow; detail: the share that they allow, permille. */
};

/* What a bank holds. */
enum evlcp_format {
    EVLCP_FORMAT_WORDS = 0, /* Info words u16 [packet][frame][cluster]; the board adds preamble and pilots. */
    EVLCP_FORMAT_MASKS = 1, /* Chip masks, row_bytes a chip, LED 0 the most significant bit of the first byte. */
    EVLCP_FORMAT_CLUSTERS = 2, /* The mask of each cluster, then chips: whole bytes, a bit a cluster, cluster 0 first. */
};

/* Info-segment profiles of air interface 1. */
enum evlcp_profile {
    EVLCP_PROFILE_WH4X2 = 0, /* Two words of H_4, 6 bits a symbol. */
    EVLCP_PROFILE_WH8 = 1, /* One word of H_8, 4 bits a symbol. */
    EVLCP_PROFILE_RAW8 = 2, /* Eight plain values, 8 bits a symbol. */
    EVLCP_PROFILE_CUSTOM = 255, /* A codebook the firmware was not built with. */
};

/* What the LEDs do. */
enum evlcp_state {
    EVLCP_STATE_DARK = 0, /* Dark; the chip timer stands. */
    EVLCP_STATE_PLAYING = 1, /* Packets of the active bank. */
    EVLCP_STATE_STOPPING = 2, /* The last packet before dark. */
    EVLCP_STATE_IDLE_PATTERN = 3, /* The idle pattern: LEDs are on for a chip of two, or of more where the limits ask for it. */
    EVLCP_STATE_TESTING = 4, /* Single-LED test. */
    EVLCP_STATE_FAULT = 5, /* Dark because of a fault. */
    EVLCP_STATE_WAITING = 6, /* Dark until the pulse or the clock that START names. */
};

/* What happens when the host falls silent. */
enum evlcp_watchdog {
    EVLCP_WATCHDOG_KEEP = 0, /* Go on playing. */
    EVLCP_WATCHDOG_IDLE = 1, /* Idle pattern from the next packet boundary until the host sends again. */
    EVLCP_WATCHDOG_DARK = 2, /* Dark after the packet; START plays again. */
};

/* Bits of HELLO.capabilities. */
enum evlcp_capability {
    EVLCP_CAPABILITY_FLASH = 1, /* SAVE and RECALL. */
    EVLCP_CAPABILITY_LEVEL = 2, /* LEVEL sets the LED current. */
    EVLCP_CAPABILITY_TEMPERATURE = 4, /* STATUS.temperature_dc is measured. */
    EVLCP_CAPABILITY_OPEN_LED = 8, /* STATUS.open_leds is measured. */
    EVLCP_CAPABILITY_RECORDS = 16, /* LED outputs are recorded (emulators). */
    EVLCP_CAPABILITY_TRUST = 64, /* KEY: requests that change something are sealed. */
    EVLCP_CAPABILITY_STREAM = 32, /* STREAM and PUSH: packets as they come. */
    EVLCP_CAPABILITY_PULSE = 512, /* START at a pulse of the pulse input, in step with it from then on, or at a clock. */
    EVLCP_CAPABILITY_UPDATE = 256, /* UPDATE_*: takes another image of its firmware. */
};

/* Bits of STATUS.faults. */
enum evlcp_fault {
    EVLCP_FAULT_OVER_TEMPERATURE = 1, /* The drivers are too hot, or the sensor's wire is broken: LEDs dark until they cool and START. */
    EVLCP_FAULT_OPEN_LED = 2, /* A LED or its wire is open; playing goes on. */
    EVLCP_FAULT_CLOCK = 4, /* The crystal did not start, or stopped: LEDs dark, timing would be wrong. */
    EVLCP_FAULT_CHIP_LOST = 8, /* A chip interrupt came a whole chip late, or chips stopped: LEDs dark. */
    EVLCP_FAULT_WATCHDOG = 16, /* The host fell silent and the watchdog acted; cleared by the next control request. */
    EVLCP_FAULT_OVER_LIMIT = 32, /* What came next was beyond the limits of light: not shown, LEDs dark until START. */
    EVLCP_FAULT_UNDERRUN = 64, /* The stream is empty though its end was not announced: idle pattern until the next packet. */
    EVLCP_FAULT_PULSE = 256, /* No pulse came, or none that fits: the board goes on by its own clock; until the next START. */
};

/* Refuse a request, with the number that goes with it. */
static inline enum evlcp_status evlcp_refuse(enum evlcp_status status, uint32_t *detail, uint32_t number)
{
    *detail = number;
    return status;
}

static inline void evlcp_copy(uint8_t *to, const uint8_t *from, uint32_t n)
{
    for (uint32_t i = 0; i < n; i++)
        to[i] = from[i];
}

/* Numbers are little-endian on the wire, as on the processors that this is for, and stand at any address. */
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers and payloads are copied as they are");

static inline void evlcp_put16(uint8_t *p, uint16_t v)
{
    __builtin_memcpy(p, &v, sizeof v);
}

static inline void evlcp_put32(uint8_t *p, uint32_t v)
{
    __builtin_memcpy(p, &v, sizeof v);
}

static inline uint16_t evlcp_get16(const uint8_t *p)
{
    uint16_t v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}

static inline uint32_t evlcp_get32(const uint8_t *p)
{
    uint32_t v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}

/* A payload as it is on the wire. */
#define EVLCP_PAYLOAD __attribute__((packed, may_alias))

/* Open a session and learn the board. Its first two fields never change between versions. */
struct EVLCP_PAYLOAD evlcp_hello_request {
    uint8_t major; /* The host's protocol; another major version is INCOMPATIBLE. */
    uint8_t minor; /* The host's protocol. */
    uint32_t nonce; /* Random; the same nonce keeps the session. */
};

/* Answer to hello. */
struct EVLCP_PAYLOAD evlcp_hello_reply {
    uint8_t major; /* The board's protocol. */
    uint8_t minor; /* The board's protocol: what came later it does not know. */
    uint16_t session; /* Goes into the header of every further request. */
    uint8_t version_major; /* Firmware version. */
    uint8_t version_minor; /* Firmware version. */
    uint8_t version_patch; /* Firmware version. */
    uint8_t window; /* Requests the host may have under way. */
    uint16_t max_payload; /* Largest payload, bytes. */
    uint8_t banks; /* Number of banks. */
    uint32_t bank_bytes; /* Size of a bank, bytes. */
    uint8_t clusters; /* Clusters. */
    uint16_t leds; /* LEDs. */
    uint32_t tick_hz; /* Rate of the tick counter that times the chips. */
    uint32_t chip_rate_max_hz; /* Fastest chip rate. */
    uint16_t level_max_ma; /* Largest LED current, mA. */
    uint16_t mean_max_ma; /* Largest mean of a LED's current, mA. */
    uint16_t burst_chips; /* Chips that a LED may be on beyond its share of any stretch of chips. */
    uint32_t capabilities; /* Capability bits. */
    uint8_t unique_id[12]; /* The part's own number. */
    uint32_t uptime_ms; /* Time since reset; smaller than before means a reset. */
    uint8_t hal[12]; /* Name of the hardware layer, ASCII, zero-padded. */
    uint32_t clock_hz; /* Rate of STATUS's clock, nominal. */
    uint8_t challenge[8]; /* Drawn for the session: seals are over it. */
    uint8_t key_name[4]; /* First bytes of the SHA-256 of the board's key; zeros without one. */
    uint16_t formats; /* What a bank may hold, 1 << format; 0: words and masks, in packets of a codebook. */
    uint32_t chip_rate_min_hz; /* Slowest chip rate. */
};

/* Set what the next COMMIT plays with, not what plays; and limits of light, which hold at once. */
struct EVLCP_PAYLOAD evlcp_configure_request {
    uint32_t chip_rate_hz; /* Chips per second; must divide the tick rate; not changed while playing. */
    uint8_t profile; /* Info-segment profile. */
    uint16_t frames; /* Frames per packet. */
    uint8_t pilot_every; /* Frames from one pilot to the next; 1: every frame has one. */
    uint16_t level_limit_ma; /* Largest LED current from now on, mA; 0: as it is. */
    uint16_t duty_limit; /* Largest share of time that a LED is on from now on, permille; 0: as it is. */
};

/* Answer to configure. */
struct EVLCP_PAYLOAD evlcp_configure_reply {
    uint32_t ticks_per_chip; /* Length of a chip in ticks. */
    uint32_t packet_chips; /* Length of a packet in chips. */
};

/* Set preamble and pilots for the next COMMIT; those of a built-in profile must be the firmware's own. */
struct EVLCP_PAYLOAD evlcp_codebook_request {
    uint8_t preamble_chips; /* Chips of the preamble, at most 32. */
    uint32_t preamble; /* Preamble, first chip on air the most significant of preamble_chips bits. */
    uint16_t pilots[16]; /* Pilot words, first chip on air the most significant bit. */
    uint8_t digest[32]; /* SHA-256 of the codebook. */
};

/* Write into a spare bank; voids what was committed in it. */
struct EVLCP_PAYLOAD evlcp_write_request {
    uint8_t bank; /* Bank. */
    uint32_t offset; /* First byte. */
};

/* Answer to write. */
struct EVLCP_PAYLOAD evlcp_write_reply {
    uint8_t bank; /* Bank. */
    uint32_t offset; /* First byte. */
    uint16_t count; /* Bytes written. */
};

/* Read from a bank. */
struct EVLCP_PAYLOAD evlcp_read_request {
    uint8_t bank; /* Bank. */
    uint32_t offset; /* First byte. */
    uint16_t count; /* Bytes wanted. */
};

/* Answer to read. */
struct EVLCP_PAYLOAD evlcp_read_reply {
    uint8_t bank; /* Bank. */
    uint32_t offset; /* First byte. */
};

/* CRC-32/ISO-HDLC of a bank's bytes. */
struct EVLCP_PAYLOAD evlcp_crc_request {
    uint8_t bank; /* Bank. */
    uint32_t offset; /* First byte. */
    uint32_t length; /* Bytes. */
};

/* Answer to crc. */
struct EVLCP_PAYLOAD evlcp_crc_reply {
    uint32_t crc; /* CRC of the bytes. */
};

/* Check a bank; play it from the next packet boundary, or, if the check fails, go on with the old one. */
struct EVLCP_PAYLOAD evlcp_commit_request {
    uint8_t bank; /* Bank. */
    uint8_t format; /* What the bank holds. */
    uint16_t packets; /* Packets in the bank. */
    uint32_t length; /* Bytes in the bank. */
    uint32_t crc; /* CRC-32 of those bytes. */
    uint8_t digest[32]; /* Digest of the codebook the content was made with. */
};

/* Answer to commit. */
struct EVLCP_PAYLOAD evlcp_commit_reply {
    uint32_t commits; /* Commits accepted since reset. */
};

/* Play the active bank from its first packet; nothing happens if it plays. */
struct EVLCP_PAYLOAD evlcp_start_request {
    uint32_t at_pulse; /* Begin at this pulse, as STATUS counts them, and keep in step; 0: not. */
    uint16_t pulse_hz; /* Pulses a second; must divide the chip rate. */
    uint32_t at_clock; /* Without a pulse: begin when STATUS's clock stands here, at most half its range ahead; 0: at once. */
};

/* Set the LED current; refused above its limit, or if what is committed were too bright. */
struct EVLCP_PAYLOAD evlcp_level_request {
    uint16_t level_ma; /* LED current, mA. */
};

/* Answer to status. */
struct EVLCP_PAYLOAD evlcp_status_reply {
    uint8_t state; /* State. */
    uint16_t faults; /* Fault bits. */
    uint8_t active_bank; /* Bank that plays or would play, or no_bank. */
    uint8_t pending_bank; /* Bank waiting for the packet boundary, or no_bank. */
    uint8_t format; /* Format of the active bank. */
    uint8_t profile; /* Profile of the active bank. */
    uint16_t frames; /* Frames per packet of the active bank. */
    uint8_t pilot_every; /* Frames from one of its pilots to the next. */
    uint16_t packets; /* Packets in the active bank. */
    uint32_t length; /* Bytes in the active bank. */
    uint32_t crc; /* CRC-32 of the active bank. */
    uint32_t chip_rate_hz; /* Chips per second, as configured. */
    uint32_t commits; /* Commits accepted since reset. */
    uint32_t packets_sent; /* Packets played to their end since reset. */
    uint32_t chips_sent; /* Chips since reset. */
    uint32_t lateness_ticks; /* Delay of the latest chip. */
    uint32_t lateness_max_ticks; /* Largest delay since START. */
    uint32_t crc_errors; /* Datagrams with a wrong CRC. */
    uint32_t framing_errors; /* Datagrams too short, too long or no COBS. */
    uint32_t overflow_errors; /* Bytes lost because the receive buffer was full. */
    uint32_t requests; /* Good datagrams received. */
    uint16_t level_ma; /* LED current, mA. */
    uint16_t level_limit_ma; /* Largest LED current that LEVEL takes, mA. */
    uint16_t duty_limit; /* Largest share of time that a LED may be on, permille; with a large LED current less. */
    uint16_t duty; /* Share of time that the active bank has a LED on, that of the brightest, permille. */
    int16_t temperature_dc; /* Driver temperature, 0.1 degree C. */
    uint8_t open_leds[12]; /* A bit a LED: open. */
    uint8_t watchdog; /* Watchdog action. */
    uint32_t watchdog_ms; /* Watchdog time-out. */
    uint32_t silence_ms; /* Time since the request before this one, HELLO left out. */
    uint32_t uptime_ms; /* Time since reset. */
    uint8_t digest[32]; /* Digest of the active bank's codebook, or of the one set. */
    uint32_t underruns; /* How often the active bank's stream was empty before its end was announced. */
    uint32_t clock; /* The board's clock, which counts freely and wraps. */
    uint32_t pulses; /* Pulses of the pulse input since reset. */
    uint32_t pulse_clocks; /* Clocks from the pulse before to the latest; 0: unknown. */
    uint32_t packet_chips; /* Length of a packet of the active bank, in chips of the chip rate. */
    uint8_t hold; /* How many of these a chip of the bank lasts; 0: the bank is of a codebook. */
    uint8_t clusters; /* Clusters of the active bank's masks; 0 without these. */
};

/* What to do when the host falls silent. */
struct EVLCP_PAYLOAD evlcp_watchdog_request {
    uint8_t action; /* Watchdog action. */
    uint32_t timeout_ms; /* Silence before it acts, at least 100 ms. */
};

/* Save active bank and settings to the older of two flash slots; only while the LEDs are dark. */
struct EVLCP_PAYLOAD evlcp_save_request {
    uint8_t autostart; /* 1: recall and play after a reset. */
};

/* Answer to save. */
struct EVLCP_PAYLOAD evlcp_save_reply {
    uint8_t slot; /* Slot written. */
    uint32_t save_sequence; /* Its sequence number. */
};

/* Answer to recall. */
struct EVLCP_PAYLOAD evlcp_recall_reply {
    uint8_t slot; /* Slot read. */
    uint32_t save_sequence; /* Its sequence number. */
};

/* Walk over LEDs one by one, at their mean current at most; not while playing. STOP or BLANK ends it. */
struct EVLCP_PAYLOAD evlcp_led_test_request {
    uint8_t first; /* First LED. */
    uint8_t last; /* Last LED. */
    uint16_t dwell_ms; /* Time a LED is on, at least 1 ms. */
};

/* Make a spare bank an empty queue of packets and play from it; idle pattern while it is empty. */
struct EVLCP_PAYLOAD evlcp_stream_request {
    uint8_t bank; /* Bank. */
    uint8_t format; /* What a packet holds. */
    uint8_t digest[32]; /* Digest of the codebook that packets are made with. */
};

/* Answer to stream. */
struct EVLCP_PAYLOAD evlcp_stream_reply {
    uint16_t slots; /* Packets that the queue holds, the one that plays among them. */
};

/* Put a piece of a packet into the queue, if it is the next and there is room; the reply says what is. */
struct EVLCP_PAYLOAD evlcp_push_request {
    uint8_t bank; /* Bank. */
    uint32_t number; /* Number of the packet, from 0 on. */
    uint16_t offset; /* First byte. */
    uint8_t last; /* 1: no further packet comes, dark after what is there; 0: playing goes on. */
};

/* Answer to push. */
struct EVLCP_PAYLOAD evlcp_push_reply {
    uint32_t number; /* Number of the packet that is next: those before it are there. */
    uint16_t offset; /* Bytes of it that are there. */
    uint32_t begun; /* Packets that have begun to play. */
    uint32_t underruns; /* How often the queue was empty before its end was announced. */
};

/* Set the key that requests which change something are sealed with; SAVE keeps it. */
struct EVLCP_PAYLOAD evlcp_key_request {
    uint8_t key[16]; /* The key; zeros for none. */
};

/* Set packets of chips alone for the next COMMIT or STREAM, in place of a codebook. */
struct EVLCP_PAYLOAD evlcp_chips_request {
    uint32_t packet_chips; /* Chips of a packet in the bank. */
    uint8_t hold; /* How many chips of the chip rate each of them lasts, from 1 on. */
    uint8_t clusters; /* Clusters of the format CLUSTERS; 0: MASKS only. */
    uint8_t digest[32]; /* SHA-256 of what chips mean, which COMMIT repeats. */
};

/* Answer to update_status. */
struct EVLCP_PAYLOAD evlcp_update_status_reply {
    uint8_t running; /* Image that runs: 0 the one that was flashed, 1 or 2 one that came by an update. */
    uint8_t trial; /* 1: it runs on trial, and is left at the third reset unless it is confirmed. */
    uint8_t next; /* Image that an update takes the place of. */
    uint32_t capacity; /* Largest image, bytes. */
    uint32_t sequence; /* Number of the newest update, 0 if there was none. */
    uint8_t target[16]; /* What the board is, ASCII, zero-padded: part and crystal. */
};

/* Erase the place of the next image; only while the LEDs are dark, and not on trial. */
struct EVLCP_PAYLOAD evlcp_update_begin_request {
    uint8_t image; /* Image, as UPDATE_STATUS says. */
    uint32_t length; /* Its bytes. */
    uint32_t crc; /* Their CRC-32/ISO-HDLC. */
};

/* Write into the place that was erased. */
struct EVLCP_PAYLOAD evlcp_update_write_request {
    uint32_t offset; /* First byte, a multiple of four. */
};

/* Answer to update_write. */
struct EVLCP_PAYLOAD evlcp_update_write_reply {
    uint32_t offset; /* First byte. */
    uint16_t count; /* Bytes written. */
};

/* Answer to update_commit. */
struct EVLCP_PAYLOAD evlcp_update_commit_reply {
    uint32_t sequence; /* Number of this update. */
};

/* What SAVE writes before a bank's content. Packets of chips alone have no frames; then see `preamble`, `pilots`. */
struct EVLCP_PAYLOAD evlcp_saved {
    uint32_t magic; /* Names this layout. */
    uint32_t sequence; /* The newest slot has the highest. */
    uint8_t autostart; /* 1: recalled and played after a reset. */
    uint8_t watchdog; /* Watchdog action. */
    uint16_t level_ma; /* LED current. */
    uint32_t watchdog_ms; /* Watchdog time-out. */
    uint8_t format; /* Of the content. */
    uint8_t profile; /* Info-segment profile. */
    uint8_t preamble_chips; /* Chips of the preamble. */
    uint8_t pilot_every; /* Frames from one pilot to the next. */
    uint16_t frames; /* Per packet; 0: chips alone. */
    uint16_t packets; /* In the content. */
    uint32_t preamble; /* Preamble, or chips of a packet in the bank. */
    uint32_t length; /* Bytes of the content. */
    uint32_t crc; /* Of the content. */
    uint32_t chip_rate_hz; /* Chips per second. */
    uint16_t pilots[16]; /* Pilot words, or in the first: hold | clusters << 8. */
    uint8_t digest[32]; /* Of the codebook, or of what chips mean. */
    uint16_t level_limit_ma; /* Largest LED current. */
    uint16_t duty_limit; /* Largest share of time, permille. */
    uint8_t key[16]; /* The board's key; zeros for none. */
    uint32_t check; /* CRC-32 of the above. */
};

/* What stands behind an image that came by an update. */
struct EVLCP_PAYLOAD evlcp_image_seal {
    uint32_t magic; /* Names this layout. */
    uint32_t sequence; /* Number of the update. */
    uint32_t length; /* Bytes of the image. */
    uint32_t crc; /* Of the image. */
    uint32_t check; /* CRC-32 of the above. */
};

#define EVLCP_REQUEST_MOST 69u /* longest request, data left out */

/* Requests: name, type, whether control, whether a query, whether only in the dark, the capability that it needs,
   whether any length may follow, and the length, that of the first minor version and today's; a shorter one goes on
   with zeros. */
#define EVLCP_REQUESTS(X) \
    X(hello, 0x01u, false, false, false, 0u, true, 6u, 6u) \
    X(configure, 0x02u, true, false, false, 0u, false, 12u, 12u) \
    X(codebook, 0x03u, true, false, false, 0u, false, 69u, 69u) \
    X(write, 0x04u, false, false, false, 0u, true, 5u, 5u) \
    X(read, 0x05u, false, true, false, 0u, false, 7u, 7u) \
    X(crc, 0x06u, false, true, false, 0u, false, 9u, 9u) \
    X(commit, 0x07u, true, false, false, 0u, false, 44u, 44u) \
    X(start, 0x08u, true, false, false, 0u, false, 0u, 10u) \
    X(stop, 0x09u, true, false, false, 0u, false, 0u, 0u) \
    X(blank, 0x0au, true, false, false, 0u, false, 0u, 0u) \
    X(level, 0x0bu, true, false, false, EVLCP_CAPABILITY_LEVEL, false, 2u, 2u) \
    X(status, 0x0cu, false, true, false, 0u, false, 0u, 0u) \
    X(watchdog, 0x0du, true, false, false, 0u, false, 5u, 5u) \
    X(save, 0x0eu, true, false, true, EVLCP_CAPABILITY_FLASH, false, 1u, 1u) \
    X(recall, 0x0fu, true, false, false, EVLCP_CAPABILITY_FLASH, false, 0u, 0u) \
    X(led_test, 0x10u, true, false, false, 0u, false, 4u, 4u) \
    X(stream, 0x18u, true, false, false, 0u, false, 34u, 34u) \
    X(push, 0x19u, false, false, false, 0u, true, 8u, 8u) \
    X(key, 0x1au, true, false, false, 0u, false, 16u, 16u) \
    X(chips, 0x1bu, true, false, false, 0u, false, 38u, 38u) \
    X(update_status, 0x20u, false, true, false, EVLCP_CAPABILITY_UPDATE, false, 0u, 0u) \
    X(update_begin, 0x21u, true, false, true, EVLCP_CAPABILITY_UPDATE, false, 9u, 9u) \
    X(update_write, 0x22u, false, false, true, EVLCP_CAPABILITY_UPDATE, true, 4u, 4u) \
    X(update_commit, 0x23u, true, false, true, EVLCP_CAPABILITY_UPDATE, false, 0u, 0u) \
    X(update_restart, 0x24u, true, false, true, EVLCP_CAPABILITY_UPDATE, false, 0u, 0u) \
    X(update_confirm, 0x25u, true, false, true, EVLCP_CAPABILITY_UPDATE, false, 0u, 0u)
