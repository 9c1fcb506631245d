/* Limits of light, kept on the rows that are sent: over any stretch of n chips a LED is on for at most
   n * duty / 1000 chips and the burst. */
#pragma once

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "composer.h"

#define EVLCP_BURST_MOST 64u /* chips */

struct evlcp_guard {
    atomic_uint_least32_t duty; /* permille; changed by the main loop */
    uint32_t burst;             /* chips * 1000 */
    /* On beyond the duty: the most of any stretch that ends now, chips * 1000; two LEDs in a word. */
    uint32_t excess[EVLCP_LEDS / 2u];
};

/* Check and count the next row. False: a LED would be on for longer than the limits allow; do not show it. */
bool evlcp_guard_check_row(struct evlcp_guard *guard, const uint8_t row[EVLCP_ROW_BYTES]);

/* Count chips during which all LEDs were dark. */
void evlcp_guard_add_dark(struct evlcp_guard *guard, uint32_t chips);

/* Share of time that a LED is on when the content is played over and over, that of the brightest, permille, rounded
   up. */
uint16_t evlcp_guard_duty(const struct evlcp_plan *plan, const uint8_t *content);
