/* A key that requests which change something must be sealed with; see docs/protocol.md. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "link.h"
#include "protocol.h"

struct evlcp_trust {
    bool able;  /* the hardware has random numbers */
    bool locked;
    uint8_t key[EVLCP_KEY_BYTES];
    uint8_t challenge[EVLCP_CHALLENGE_BYTES]; /* of the session */
    uint32_t newest;                          /* number of the latest request, 32 bits of it */
};

/* Set the key; all zeros is none. */
void evlcp_trust_set_key(struct evlcp_trust *trust, const uint8_t key[EVLCP_KEY_BYTES]);

/* First bytes of the key's SHA-256; zeros without a key. */
void evlcp_trust_key_name(const struct evlcp_trust *trust, uint8_t name[EVLCP_KEY_NAME_BYTES]);

/* A new session, whose HELLO had this sequence: draw its challenge. */
void evlcp_trust_begin_session(struct evlcp_trust *trust, uint16_t sequence);

/* Remove the seal of a request of the session; *sealed: whether it had a valid one by the board's key. */
enum evlcp_status evlcp_trust_unseal(struct evlcp_trust *trust, struct evlcp_datagram *datagram, bool *sealed);
