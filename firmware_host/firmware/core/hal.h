/* What the core asks of the hardware: the only way from the core to the outside. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

/* Facts of a board that do not change. */
struct evlcp_hal_info {
    uint32_t tick_hz;            /* rate of the timer that times the chips */
    uint32_t ticks_per_chip_max; /* longest chip */
    uint32_t chip_rate_max_hz;   /* fastest chip rate */
    uint16_t level_max_ma;       /* largest LED current */
    uint16_t level_default_ma;   /* LED current after reset */
    uint16_t mean_max_ma;        /* largest mean of a LED's current */
    uint16_t burst_chips;        /* that a LED may be on beyond its share */
    uint32_t capabilities;       /* enum evlcp_capability */
    uint32_t clock_hz;           /* rate of hal_clock, nominal */
    uint8_t unique_id[12];
    uint8_t name[12]; /* of the hardware layer, ASCII, zero-padded */
    uint8_t target[16]; /* what an image is built for */
};

#define EVLCP_START_LEAD_US 2000u

/* The sensors; a temperature of INT16_MIN is not measured. `faults` has over_temperature, open_led and clock of enum
   evlcp_fault. */
struct evlcp_health {
    int16_t temperature_dc;
    uint8_t faults;
    uint8_t open_leds[EVLCP_ROW_BYTES];
};

/* Pulses of a clock that several boards share; `between` is 0 until there are two. */
struct evlcp_pulse {
    uint32_t count;   /* since reset */
    uint32_t at;      /* hal_clock at the latest */
    uint32_t between; /* from the one before, clocks */
};

/* The start of chips; with a pulse they stay in step with it. */
struct evlcp_when {
    uint32_t at;       /* hal_clock */
    uint32_t pulse;    /* its number; 0: none */
    uint16_t pulse_hz; /* divides the chip rate */
    uint32_t chip_rate_hz;
};

/* The board's constants. */
void hal_get_info(struct evlcp_hal_info *info);

/* Show a row of LEDs, LED 0 the most significant bit of row[0]. `chip` is its number since START, or
   EVLCP_CHIP_DARK (blank: at once, or from the chip call when the rows before have had their time) or
   EVLCP_CHIP_TEST. The only output; nothing else lights a LED. */
void hal_show_leds(const uint8_t *row, uint32_t chip);

/* Call evlcp_chip every `ticks` from now on; 0 stops it: there is no call after the return. Never called
   while it runs except to stop it. */
void hal_set_chip_clock(uint32_t ticks);

/* The next hal_set_chip_clock begins then, not at once; it is called up to EVLCP_START_LEAD_US before, and may wait. */
void hal_schedule_start(const struct evlcp_when *when);

/* A clock that counts freely and wraps. */
uint32_t hal_clock(void);

/* The pulses so far. False: one is overdue, or came at a wrong time, since the last hal_schedule_start. */
bool hal_read_pulse(struct evlcp_pulse *pulse);

/* Ticks between the moment the running chip call was due and now. */
uint32_t hal_lateness(void);

/* Milliseconds since reset, free to wrap. Called by the main loop alone. */
uint32_t hal_millis(void);

/* Unpredictable random numbers; false if the board has none. */
bool hal_random(uint8_t *bytes, uint32_t count);

/* Take bytes to send; returns how many were taken, and never waits. */
uint32_t hal_send(const uint8_t *bytes, uint32_t count);

/* Bytes that the receiver hardware lost since the last call. */
uint32_t hal_lost_bytes(void);

/* Set the LED current; false if the hardware does not follow. */
bool hal_set_level(uint16_t level_ma);

/* Read the sensors. */
void hal_read_health(struct evlcp_health *health);

/* Two flash slots of at least EVLCP_SLOT_BYTES each, and, with EVLCP_CAPABILITY_UPDATE, two more of
   EVLCP_IMAGE_SLOT_BYTES. Called only while no chip call runs. What cannot be read may be anything: a CRC is over it. */
bool hal_flash_erase(uint8_t slot);
bool hal_flash_write(uint8_t slot, uint32_t offset, const uint8_t *bytes, uint32_t count);
void hal_flash_read(uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t count);

/* The image that runs: 0 the one that was flashed, 1 or 2 one that came by an update. */
uint8_t hal_running_image(void);

/* Reset; it may return before that happens. */
void hal_restart(void);
