/* The board: answers requests, plays chips. The HAL owns one, calls evlcp_init once, evlcp_receive from the
   receive interrupt, evlcp_chip from the chip interrupt (the highest priority) and evlcp_poll without pause. */
#pragma once

#include "banks.h"
#include "hal.h"
#include "link.h"
#include "player.h"
#include "trust.h"
#include "update.h"

#define EVLCP_VERSION_MAJOR 1u
#define EVLCP_VERSION_MINOR 0u
#define EVLCP_VERSION_PATCH 0u

#define EVLCP_SLOTS 2u
#define EVLCP_SLOT_BYTES (sizeof(struct evlcp_saved) + EVLCP_BANK_BYTES)

struct evlcp_watch {
    uint8_t action;
    uint32_t timeout_ms;
    uint32_t host_ms;         /* time of the latest request */
    uint32_t silence_from_ms; /* the same without HELLO */
    bool fired;               /* it acts, until the next request */
    bool acted;               /* it has acted, until the next control request */
};

struct evlcp_test {
    bool on;
    uint8_t led;
    uint8_t last;
    uint16_t dwell_ms;
    uint32_t since_ms;
};

/* A START that waits. */
struct evlcp_start {
    bool waiting;
    bool missed; /* the pulse fault */
    uint32_t at_pulse;
    uint16_t pulse_hz;
    uint32_t at_clock;
};

/* The last control request, to answer a repeated one and to refuse an older one. */
struct evlcp_control {
    bool known;
    uint8_t type;
    uint8_t status;
    uint16_t sequence; /* requests not after it are stale */
    uint16_t newest;
    uint8_t reply[8];
    uint32_t length;
};

struct evlcp {
    struct evlcp_hal_info info;
    struct evlcp_link link;
    struct evlcp_banks banks;
    struct evlcp_player player;
    struct evlcp_setup setup;
    struct evlcp_watch watch;
    struct evlcp_test test;
    struct evlcp_control control;
    struct evlcp_update update;
    struct evlcp_start start;
    struct evlcp_trust trust;
    struct evlcp_health health;
    uint32_t health_ms;
    uint32_t nonce;
    uint16_t session;
    uint16_t level_ma;
    uint16_t level_limit_ma;
    uint16_t duty_limit; /* permille */
    uint8_t latched; /* faults that hold the LEDs dark until START finds them gone */
    uint32_t requests;
    uint8_t payload[EVLCP_MAX_PAYLOAD];
};

/* A request on its way through its handler. */
struct exchange {
    uint16_t sequence;
    const uint8_t *in;
    uint32_t in_length;
    uint8_t *out;
    uint32_t out_length;
    uint32_t detail;
};

/* Begin, in memory that is zero: LEDs dark, no session; a flash slot saved with autostart is recalled and played. */
void evlcp_init(struct evlcp *e);

/* Bytes were received. */
void evlcp_receive(struct evlcp *e, const uint8_t *bytes, uint32_t count);

/* A chip is due. */
void evlcp_chip(struct evlcp *e);

/* The hardware failed, and the HAL has gone dark by itself: from the main loop, once for each failure. The fault is
   what the health says, or CHIP_LOST; the LEDs stay dark until START finds it gone. */
void evlcp_hardware_failed(struct evlcp *e);

/* Everything that is not urgent. */
void evlcp_poll(struct evlcp *e);

/* Answer a request by a payload, a structure of protocol.h. */
enum evlcp_status evlcp_answer(struct exchange *x, const void *payload, uint32_t bytes);

/* Requests that are handled beside what they are about: in settings.c and update.c. */
enum evlcp_status on_save(struct evlcp *e, struct exchange *x);
enum evlcp_status on_update_status(struct evlcp *e, struct exchange *x);
enum evlcp_status on_update_begin(struct evlcp *e, struct exchange *x);
enum evlcp_status on_update_write(struct evlcp *e, struct exchange *x);
enum evlcp_status on_update_commit(struct evlcp *e, struct exchange *x);
enum evlcp_status on_update_restart(struct evlcp *e, struct exchange *x);
enum evlcp_status on_update_confirm(struct evlcp *e, struct exchange *x);

/* Take settings back from the newest good slot, or from none. */
enum evlcp_status evlcp_settings_recall(struct evlcp *e, bool only_autostart, struct evlcp_recall_reply *reply);

/* Load the key of the newest valid slot. */
void evlcp_settings_load_key(struct evlcp *e);

/* Share of time that a LED may be on with a current and a limit, permille. */
uint32_t evlcp_allowed_duty(const struct evlcp *e, uint32_t level_ma, uint32_t duty_limit);

/* Set current and limits, as they are allowed together; false if the hardware does not follow. */
bool evlcp_set_light(struct evlcp *e, uint16_t level_ma, uint16_t level_limit_ma, uint16_t duty_limit);

/* Make a checked bank active: now if nothing plays, else at the packet boundary. */
void evlcp_activate(struct evlcp *e, uint8_t bank);
