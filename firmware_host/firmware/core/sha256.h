/* SHA-256 (FIPS 180-4), and what HMAC (RFC 2104) needs of it. */
#pragma once

#include <stdint.h>

#define EVLCP_SHA256_BYTES 32u
#define EVLCP_SHA256_BLOCK 64u

struct evlcp_sha256 {
    uint32_t state[8];
    uint32_t length; /* bytes taken, fewer than 2^29 */
    uint8_t block[EVLCP_SHA256_BLOCK];
};

void evlcp_sha256_begin(struct evlcp_sha256 *hash);
void evlcp_sha256_add(struct evlcp_sha256 *hash, const uint8_t *bytes, uint32_t count);
void evlcp_sha256_end(struct evlcp_sha256 *hash, uint8_t digest[EVLCP_SHA256_BYTES]);

#define EVLCP_HMAC_INNER 0x36u
#define EVLCP_HMAC_OUTER 0x5cu

/* Begin the inner or outer hash of an HMAC, with a key of at most EVLCP_SHA256_BLOCK bytes. */
void evlcp_sha256_begin_keyed(struct evlcp_sha256 *hash, const uint8_t *key, uint32_t count, uint8_t pad);
