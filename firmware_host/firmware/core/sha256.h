/* SHA-256 (FIPS 180-4), and HMAC with it (RFC 2104). */
#ifndef EVLCP_SHA256_H
#define EVLCP_SHA256_H

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

struct evlcp_hmac {
    struct evlcp_sha256 inner;
    uint8_t outer_key[EVLCP_SHA256_BLOCK];
};

/* With a key of at most EVLCP_SHA256_BLOCK bytes. */
void evlcp_hmac_begin(struct evlcp_hmac *mac, const uint8_t *key, uint32_t count);
void evlcp_hmac_end(struct evlcp_hmac *mac, uint8_t digest[EVLCP_SHA256_BYTES]);

#endif
