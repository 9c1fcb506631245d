#include "update.h"

#include "crc32.h"
#include "hal.h"

#define MAGIC 0x45564c55u
#define CHUNK 256u
#define ERASED 0xffffffffu

/* Behind an image: its seal, then words that are programmed to zero. */
#define SEAL_AT EVLCP_IMAGE_BYTES
#define TRIES_AT (SEAL_AT + 32u)
#define CONFIRMED_AT (SEAL_AT + 48u)

static uint32_t read_word(uint8_t image, uint32_t offset)
{
    uint8_t bytes[4];
    return hal_flash_read((uint8_t)(EVLCP_IMAGE_SLOT + image), offset, bytes, 4u) ? evlcp_get32(bytes) : 0u;
}

static bool clear_word(uint8_t image, uint32_t offset)
{
    static const uint8_t zero[4];
    return hal_flash_write((uint8_t)(EVLCP_IMAGE_SLOT + image), offset, zero, 4u) && read_word(image, offset) == 0u;
}

bool evlcp_flash_crc(uint8_t slot, uint32_t offset, uint32_t length, uint32_t *crc)
{
    *crc = 0u;
    for (uint32_t at = 0; at < length; at += CHUNK) {
        uint8_t bytes[CHUNK];
        uint32_t count = length - at < CHUNK ? length - at : CHUNK;
        if (!hal_flash_read(slot, offset + at, bytes, count))
            return false;
        *crc = evlcp_crc32(*crc, bytes, count);
    }
    return true;
}

static bool image_crc(uint8_t image, uint32_t length, uint32_t *crc)
{
    return evlcp_flash_crc((uint8_t)(EVLCP_IMAGE_SLOT + image), 0u, length, crc);
}

/* Whether a place has a whole image. */
static bool has_valid_image(uint8_t image, struct evlcp_image_seal *seal)
{
    uint8_t b[EVLCP_IMAGE_SEAL_BYTES];
    uint32_t crc;
    if (!hal_flash_read((uint8_t)(EVLCP_IMAGE_SLOT + image), SEAL_AT, b, sizeof b))
        return false;
    *seal = evlcp_image_seal_get(b);
    return seal->magic == MAGIC && seal->check == evlcp_crc32(0u, b, sizeof b - 4u) &&
           seal->length <= EVLCP_IMAGE_BYTES && image_crc(image, seal->length, &crc) && crc == seal->crc;
}

static bool is_newer(uint32_t a, uint32_t b)
{
    return (int32_t)(a - b) > 0;
}

static bool is_confirmed(uint8_t image)
{
    return read_word(image, CONFIRMED_AT) == 0u;
}

/* Whether a place has an image that runs, or would run. */
static bool is_bootable(uint8_t image, struct evlcp_image_seal *seal)
{
    return has_valid_image(image, seal) &&
           (is_confirmed(image) || read_word(image, TRIES_AT + 4u * (EVLCP_TRIES - 1u)) == ERASED);
}

uint8_t evlcp_update_pick_image(void)
{
    struct evlcp_image_seal seals[EVLCP_IMAGES];
    bool valid[EVLCP_IMAGES];
    for (uint8_t i = 0; i < EVLCP_IMAGES; i++)
        valid[i] = is_bootable(i, &seals[i]);
    uint8_t first = valid[1] && (!valid[0] || is_newer(seals[1].sequence, seals[0].sequence)) ? 1u : 0u;
    for (uint8_t turn = 0; turn < EVLCP_IMAGES; turn++) {
        uint8_t i = turn == 0u ? first : (uint8_t)(1u - first);
        if (!valid[i])
            continue;
        if (is_confirmed(i))
            return (uint8_t)(i + 1u);
        for (uint32_t n = 0; n < EVLCP_TRIES; n++) {
            uint32_t at = TRIES_AT + 4u * n;
            /* A try that cannot be counted is not made. */
            if (read_word(i, at) == ERASED && clear_word(i, at))
                return (uint8_t)(i + 1u);
        }
    }
    return 0u;
}

/* The place for an update: not the running one, else an empty one, else the older. */
static uint8_t next_image(uint32_t *newest)
{
    struct evlcp_image_seal seals[EVLCP_IMAGES];
    bool valid[EVLCP_IMAGES];
    uint8_t running = hal_running_image();
    *newest = 0u;
    for (uint8_t i = 0; i < EVLCP_IMAGES; i++) {
        valid[i] = has_valid_image(i, &seals[i]);
        if (valid[i] && (*newest == 0u || is_newer(seals[i].sequence, *newest)))
            *newest = seals[i].sequence;
    }
    if (running != 0u)
        return running == 1u ? 1u : 0u;
    return valid[0] && (!valid[1] || is_newer(seals[0].sequence, seals[1].sequence)) ? 1u : 0u;
}

static bool is_on_trial(void)
{
    uint8_t running = hal_running_image();
    return running != 0u && !is_confirmed((uint8_t)(running - 1u));
}

void evlcp_update_fill_status(struct evlcp_update_status_reply *reply)
{
    reply->running = hal_running_image();
    reply->trial = is_on_trial() ? 1u : 0u;
    reply->next = (uint8_t)(next_image(&reply->sequence) + 1u);
    reply->capacity = EVLCP_IMAGE_BYTES;
}

enum evlcp_status evlcp_update_begin(struct evlcp_update *u, const struct evlcp_update_begin_request *request,
                                     uint32_t *detail)
{
    uint32_t newest;
    uint8_t image = next_image(&newest);
    if (is_on_trial()) /* the image before it must stay until this one has proven itself */
        return EVLCP_STATUS_BUSY;
    if (request->image != image + 1u)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, image + 1u);
    if (request->length == 0u || request->length > EVLCP_IMAGE_BYTES)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, EVLCP_IMAGE_BYTES);
    u->open = hal_flash_erase((uint8_t)(EVLCP_IMAGE_SLOT + image));
    u->image = image;
    u->length = request->length;
    u->crc = request->crc;
    return u->open ? EVLCP_STATUS_OK : EVLCP_STATUS_FLASH_FAULT;
}

enum evlcp_status evlcp_update_write(const struct evlcp_update *u, uint32_t offset, const uint8_t *bytes,
                                     uint32_t count, uint32_t *detail)
{
    if (!u->open)
        return EVLCP_STATUS_NOTHING_COMMITTED;
    if (offset % 4u != 0u || offset > u->length || count > u->length - offset)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, detail, u->length);
    return hal_flash_write((uint8_t)(EVLCP_IMAGE_SLOT + u->image), offset, bytes, count)
               ? EVLCP_STATUS_OK
               : EVLCP_STATUS_FLASH_FAULT;
}

enum evlcp_status evlcp_update_commit(struct evlcp_update *u, uint32_t *sequence, uint32_t *detail)
{
    uint8_t b[EVLCP_IMAGE_SEAL_BYTES];
    if (!u->open)
        return EVLCP_STATUS_NOTHING_COMMITTED;
    if (!image_crc(u->image, u->length, detail))
        return EVLCP_STATUS_FLASH_FAULT;
    if (*detail != u->crc)
        return EVLCP_STATUS_BAD_CRC;
    (void)next_image(sequence);
    *sequence += 1u;
    u->open = false;
    struct evlcp_image_seal seal = {.magic = MAGIC, .sequence = *sequence, .length = u->length, .crc = u->crc};
    (void)evlcp_image_seal_put(b, &seal);
    evlcp_put32(b + sizeof b - 4u, evlcp_crc32(0u, b, sizeof b - 4u));
    if (!hal_flash_write((uint8_t)(EVLCP_IMAGE_SLOT + u->image), SEAL_AT, b, sizeof b) ||
        !has_valid_image(u->image, &seal))
        return EVLCP_STATUS_FLASH_FAULT;
    return EVLCP_STATUS_OK;
}

enum evlcp_status evlcp_update_confirm(void)
{
    uint8_t running = hal_running_image();
    if (!is_on_trial())
        return EVLCP_STATUS_OK;
    return clear_word((uint8_t)(running - 1u), CONFIRMED_AT) ? EVLCP_STATUS_OK : EVLCP_STATUS_FLASH_FAULT;
}
