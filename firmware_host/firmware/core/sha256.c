#include "sha256.h"

static const uint32_t k[64] = {
    0x428a2f98u, 0x71374491u, 0xb5c0fbcfu, 0xe9b5dba5u, 0x3956c25bu, 0x59f111f1u, 0x923f82a4u, 0xab1c5ed5u,
    0xd807aa98u, 0x12835b01u, 0x243185beu, 0x550c7dc3u, 0x72be5d74u, 0x80deb1feu, 0x9bdc06a7u, 0xc19bf174u,
    0xe49b69c1u, 0xefbe4786u, 0x0fc19dc6u, 0x240ca1ccu, 0x2de92c6fu, 0x4a7484aau, 0x5cb0a9dcu, 0x76f988dau,
    0x983e5152u, 0xa831c66du, 0xb00327c8u, 0xbf597fc7u, 0xc6e00bf3u, 0xd5a79147u, 0x06ca6351u, 0x14292967u,
    0x27b70a85u, 0x2e1b2138u, 0x4d2c6dfcu, 0x53380d13u, 0x650a7354u, 0x766a0abbu, 0x81c2c92eu, 0x92722c85u,
    0xa2bfe8a1u, 0xa81a664bu, 0xc24b8b70u, 0xc76c51a3u, 0xd192e819u, 0xd6990624u, 0xf40e3585u, 0x106aa070u,
    0x19a4c116u, 0x1e376c08u, 0x2748774cu, 0x34b0bcb5u, 0x391c0cb3u, 0x4ed8aa4au, 0x5b9cca4fu, 0x682e6ff3u,
    0x748f82eeu, 0x78a5636fu, 0x84c87814u, 0x8cc70208u, 0x90befffau, 0xa4506cebu, 0xbef9a3f7u, 0xc67178f2u};

static uint32_t turn(uint32_t x, uint32_t n)
{
    return x >> n | x << (32u - n);
}

static void compress(struct evlcp_sha256 *hash)
{
    uint32_t w[64];
    uint32_t s[8];
    for (uint32_t i = 0; i < 16u; i++) {
        const uint8_t *b = hash->block + 4u * i;
        w[i] = (uint32_t)b[0] << 24 | (uint32_t)b[1] << 16 | (uint32_t)b[2] << 8 | b[3];
    }
    for (uint32_t i = 16; i < 64u; i++)
        w[i] = w[i - 16] + (turn(w[i - 15], 7) ^ turn(w[i - 15], 18) ^ w[i - 15] >> 3) + w[i - 7] +
               (turn(w[i - 2], 17) ^ turn(w[i - 2], 19) ^ w[i - 2] >> 10);
    for (uint32_t i = 0; i < 8u; i++)
        s[i] = hash->state[i];
    for (uint32_t i = 0; i < 64u; i++) {
        uint32_t one = s[7] + (turn(s[4], 6) ^ turn(s[4], 11) ^ turn(s[4], 25)) + ((s[4] & s[5]) ^ (~s[4] & s[6])) +
                       k[i] + w[i];
        uint32_t two = (turn(s[0], 2) ^ turn(s[0], 13) ^ turn(s[0], 22)) +
                       ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
        for (uint32_t j = 7; j > 0u; j--)
            s[j] = s[j - 1u];
        s[4] += one;
        s[0] = one + two;
    }
    for (uint32_t i = 0; i < 8u; i++)
        hash->state[i] += s[i];
}

void evlcp_sha256_begin(struct evlcp_sha256 *hash)
{
    static const uint32_t start[8] = {0x6a09e667u, 0xbb67ae85u, 0x3c6ef372u, 0xa54ff53au,
                                      0x510e527fu, 0x9b05688cu, 0x1f83d9abu, 0x5be0cd19u};
    for (uint32_t i = 0; i < 8u; i++)
        hash->state[i] = start[i];
    hash->length = 0u;
}

void evlcp_sha256_add(struct evlcp_sha256 *hash, const uint8_t *bytes, uint32_t count)
{
    for (uint32_t i = 0; i < count; i++) {
        hash->block[hash->length++ % EVLCP_SHA256_BLOCK] = bytes[i];
        if (hash->length % EVLCP_SHA256_BLOCK == 0u)
            compress(hash);
    }
}

void evlcp_sha256_end(struct evlcp_sha256 *hash, uint8_t digest[EVLCP_SHA256_BYTES])
{
    static const uint8_t end[EVLCP_SHA256_BLOCK] = {0x80u};
    uint32_t bits = 8u * hash->length;
    uint8_t length[8] = {0u, 0u, 0u, 0u, (uint8_t)(bits >> 24), (uint8_t)(bits >> 16), (uint8_t)(bits >> 8),
                         (uint8_t)bits};
    /* One bit, then zeros up to eight bytes before the end of a block. */
    evlcp_sha256_add(hash, end, 1u + (119u - hash->length % EVLCP_SHA256_BLOCK) % EVLCP_SHA256_BLOCK);
    evlcp_sha256_add(hash, length, sizeof length);
    for (uint32_t i = 0; i < EVLCP_SHA256_BYTES; i++)
        digest[i] = (uint8_t)(hash->state[i / 4u] >> (24u - 8u * (i % 4u)));
}

void evlcp_sha256_begin_keyed(struct evlcp_sha256 *hash, const uint8_t *key, uint32_t count, uint8_t pad)
{
    uint8_t block[EVLCP_SHA256_BLOCK];
    for (uint32_t i = 0; i < EVLCP_SHA256_BLOCK; i++)
        block[i] = (i < count ? key[i] : 0u) ^ pad;
    evlcp_sha256_begin(hash);
    evlcp_sha256_add(hash, block, sizeof block);
}
