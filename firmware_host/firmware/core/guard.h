/* Limits of light, kept on the rows that are sent: over any stretch of n chips a LED is on for at most
   n * duty / 1000 chips and the burst. */
#ifndef EVLCP_GUARD_H
#define EVLCP_GUARD_H

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

/* A row is next. False: a LED would be on for longer than the limits allow, the row must not be shown. */
bool evlcp_guard_take(struct evlcp_guard *guard, const uint8_t row[EVLCP_ROW_BYTES]);

/* All LEDs were dark for so many chips. */
void evlcp_guard_rest(struct evlcp_guard *guard, uint32_t chips);

/* Share of time that a LED is on when the content is played over and over, that of the brightest, permille, rounded
   up. */
uint16_t evlcp_guard_duty(const struct evlcp_plan *plan, const uint8_t *content);

#endif
