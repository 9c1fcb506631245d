#include "trust.h"

#include "hal.h"
#include "sha256.h"

void evlcp_trust_set_key(struct evlcp_trust *trust, const uint8_t key[EVLCP_KEY_BYTES])
{
    uint32_t any = 0u;
    for (uint32_t i = 0; i < EVLCP_KEY_BYTES; i++)
        any |= key[i];
    evlcp_copy(trust->key, key, EVLCP_KEY_BYTES);
    trust->locked = any != 0u;
}

void evlcp_trust_key_name(const struct evlcp_trust *trust, uint8_t name[EVLCP_KEY_NAME_BYTES])
{
    uint8_t digest[EVLCP_SHA256_BYTES] = {0};
    struct evlcp_sha256 hash;
    if (trust->locked) {
        evlcp_sha256_begin(&hash);
        evlcp_sha256_add(&hash, trust->key, EVLCP_KEY_BYTES);
        evlcp_sha256_end(&hash, digest);
    }
    evlcp_copy(name, digest, EVLCP_KEY_NAME_BYTES);
}

void evlcp_trust_begin_session(struct evlcp_trust *trust, uint16_t sequence)
{
    /* Without it a session that was recorded could be played back. */
    trust->able = hal_random(trust->challenge, EVLCP_CHALLENGE_BYTES);
    trust->newest = sequence;
}

/* A request's number goes on where its 16 bits in the header wrap, so that none of them comes twice. */
static uint32_t request_number(const struct evlcp_trust *trust, uint16_t sequence)
{
    uint32_t ahead = (sequence - trust->newest) & 0xffffu;
    return trust->newest + ahead - (ahead >= 0x8000u ? 0x10000u : 0u);
}

static bool has_valid_seal(const struct evlcp_trust *trust, const struct evlcp_datagram *d, uint32_t number)
{
    uint8_t head[8];
    uint8_t digest[EVLCP_SHA256_BYTES];
    struct evlcp_sha256 hash;
    uint32_t differ = 0u;
    head[0] = d->type;
    head[1] = EVLCP_SEALED;
    evlcp_put16(head + 2, d->session);
    evlcp_put32(head + 4, number);
    evlcp_sha256_begin_keyed(&hash, trust->key, EVLCP_KEY_BYTES, EVLCP_HMAC_INNER);
    evlcp_sha256_add(&hash, trust->challenge, EVLCP_CHALLENGE_BYTES);
    evlcp_sha256_add(&hash, head, sizeof head);
    evlcp_sha256_add(&hash, d->payload, d->length);
    evlcp_sha256_end(&hash, digest);
    evlcp_sha256_begin_keyed(&hash, trust->key, EVLCP_KEY_BYTES, EVLCP_HMAC_OUTER);
    evlcp_sha256_add(&hash, digest, sizeof digest);
    evlcp_sha256_end(&hash, digest);
    /* In a time that does not tell how much of it is right. */
    for (uint32_t i = 0; i < EVLCP_SEAL_BYTES; i++)
        differ |= (uint32_t)(digest[i] ^ d->payload[d->length + i]);
    return differ == 0u;
}

enum evlcp_status evlcp_trust_unseal(struct evlcp_trust *trust, struct evlcp_datagram *datagram, bool *sealed)
{
    *sealed = false;
    if (datagram->status != EVLCP_SEALED)
        return EVLCP_STATUS_OK;
    if (datagram->length < EVLCP_SEAL_BYTES || !trust->able || !trust->locked)
        return EVLCP_STATUS_BAD_SEAL;
    datagram->length -= EVLCP_SEAL_BYTES;
    uint32_t number = request_number(trust, datagram->sequence);
    if (!has_valid_seal(trust, datagram, number))
        return EVLCP_STATUS_BAD_SEAL;
    if ((int32_t)(number - trust->newest) > 0)
        trust->newest = number;
    *sealed = true;
    return EVLCP_STATUS_OK;
}
