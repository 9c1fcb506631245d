/* Banks of content, and which of them plays. */
#pragma once

#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>

#include "composer.h"
#include "stream.h"

#define EVLCP_BANKS 2u
#define EVLCP_BANK_BYTES 40960u

struct evlcp_banks {
    uint8_t content[EVLCP_BANKS][EVLCP_BANK_BYTES];
    struct evlcp_plan plan[EVLCP_BANKS];
    struct evlcp_stream stream[EVLCP_BANKS];
    /* `active` is changed by the chip interrupt while chips run, else by the main loop; `pending` is set by the
       main loop and cleared by whoever makes it active. */
    atomic_uchar active;
    atomic_uchar pending;
    uint32_t commits;
};

/* Empty banks. */
void evlcp_banks_init(struct evlcp_banks *banks);

/* Setup of the codebook the firmware was built with. */
void evlcp_setup_init(struct evlcp_setup *setup, uint32_t tick_hz);

/* Whether a digest may stand for a profile: a built-in one has the firmware's own, a custom one any. */
bool evlcp_profile_digest_ok(uint8_t profile, const uint8_t digest[32]);

/* Whether the bytes lie in a bank. */
bool evlcp_banks_range_ok(uint8_t bank, uint32_t offset, uint32_t count);

/* Whether a bank plays or is about to. */
bool evlcp_banks_in_use(const struct evlcp_banks *banks, uint8_t bank);

/* Check a bank's content against setup and request, and fill its plan; the plan is valid only on OK. */
enum evlcp_status evlcp_banks_check(struct evlcp_banks *banks, const struct evlcp_setup *setup,
                                    const struct evlcp_commit_request *request, uint32_t *detail);

/* Make a spare bank an empty stream against the setup, and fill its plan; the plan is valid only on OK. */
enum evlcp_status evlcp_banks_stream(struct evlcp_banks *banks, const struct evlcp_setup *setup,
                                     const struct evlcp_stream_request *request, uint32_t *detail);

/* Make the pending bank active, if there is one. True if it changed. */
bool evlcp_banks_swap(struct evlcp_banks *banks);
