/* UPDATE_*: two flash slots for images, written in turn, each with a seal behind it. */
#include "crc32.h"
#include "evlcp.h"

#define MAGIC 0x45564c55u
#define CHUNK 256u
#define ERASED 0xffffffffu

/* Behind an image: its seal, then words that are programmed to zero. */
#define SEAL_AT EVLCP_IMAGE_BYTES
#define TRIES_AT (SEAL_AT + 32u)
#define CONFIRMED_AT (SEAL_AT + 48u)

static uint8_t slot_of(uint8_t image)
{
    return (uint8_t)(EVLCP_IMAGE_SLOT + image);
}

static uint32_t read_word(uint8_t image, uint32_t offset)
{
    uint8_t bytes[4];
    hal_flash_read(slot_of(image), offset, bytes, sizeof bytes);
    return evlcp_get32(bytes);
}

static bool clear_word(uint8_t image, uint32_t offset)
{
    static const uint8_t zero[4];
    return hal_flash_write(slot_of(image), offset, zero, sizeof zero) && read_word(image, offset) == 0u;
}

uint32_t evlcp_flash_crc(uint8_t slot, uint32_t offset, uint32_t length)
{
    uint32_t crc = 0u;
    for (uint32_t at = 0; at < length; at += CHUNK) {
        uint8_t bytes[CHUNK];
        uint32_t count = length - at < CHUNK ? length - at : CHUNK;
        hal_flash_read(slot, offset + at, bytes, count);
        crc = evlcp_crc32(crc, bytes, count);
    }
    return crc;
}

/* Whether a place has a whole image. */
static bool has_valid_image(uint8_t image, struct evlcp_image_seal *seal)
{
    hal_flash_read(slot_of(image), SEAL_AT, (uint8_t *)seal, sizeof *seal);
    return seal->magic == MAGIC && seal->check == evlcp_crc32(0u, (uint8_t *)seal, sizeof *seal - 4u) &&
           seal->length <= EVLCP_IMAGE_BYTES && evlcp_flash_crc(slot_of(image), 0u, seal->length) == seal->crc;
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

enum evlcp_status on_update_status(struct evlcp *e, struct exchange *x)
{
    uint32_t newest;
    uint8_t image = next_image(&newest);
    struct evlcp_update_status_reply reply = {.running = hal_running_image(),
                                              .trial = is_on_trial() ? 1u : 0u,
                                              .next = (uint8_t)(image + 1u),
                                              .sequence = newest,
                                              .capacity = EVLCP_IMAGE_BYTES};
    evlcp_copy(reply.target, e->info.target, sizeof reply.target);
    return evlcp_answer(x, &reply, sizeof reply);
}

enum evlcp_status on_update_begin(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_update_begin_request request = *(const struct evlcp_update_begin_request *)x->in;
    uint32_t newest;
    uint8_t image = next_image(&newest);
    if (is_on_trial()) /* the image before it must stay until this one has proven itself */
        return EVLCP_STATUS_BUSY;
    if (request.image != image + 1u)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, &x->detail, image + 1u);
    if (request.length == 0u || request.length > EVLCP_IMAGE_BYTES)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, &x->detail, EVLCP_IMAGE_BYTES);
    e->update.open = hal_flash_erase(slot_of(image));
    e->update.image = image;
    e->update.length = request.length;
    e->update.crc = request.crc;
    return e->update.open ? EVLCP_STATUS_OK : EVLCP_STATUS_FLASH_FAULT;
}

enum evlcp_status on_update_write(struct evlcp *e, struct exchange *x)
{
    const struct evlcp_update *u = &e->update;
    const struct evlcp_update_write_request request = *(const struct evlcp_update_write_request *)x->in;
    uint32_t offset = request.offset, count = x->in_length - (uint32_t)sizeof request;
    if (!u->open)
        return EVLCP_STATUS_NOTHING_COMMITTED;
    if (offset % 4u != 0u || offset > u->length || count > u->length - offset)
        return evlcp_refuse(EVLCP_STATUS_OUT_OF_RANGE, &x->detail, u->length);
    if (!hal_flash_write(slot_of(u->image), offset, x->in + sizeof request, count))
        return EVLCP_STATUS_FLASH_FAULT;
    const struct evlcp_update_write_reply reply = {.offset = offset, .count = (uint16_t)count};
    return evlcp_answer(x, &reply, sizeof reply);
}

enum evlcp_status on_update_commit(struct evlcp *e, struct exchange *x)
{
    struct evlcp_update *u = &e->update;
    uint32_t newest;
    if (!u->open)
        return EVLCP_STATUS_NOTHING_COMMITTED;
    x->detail = evlcp_flash_crc(slot_of(u->image), 0u, u->length);
    if (x->detail != u->crc)
        return EVLCP_STATUS_BAD_CRC;
    (void)next_image(&newest);
    u->open = false;
    const struct evlcp_update_commit_reply reply = {.sequence = newest + 1u};
    struct evlcp_image_seal seal = {.magic = MAGIC, .sequence = reply.sequence, .length = u->length, .crc = u->crc};
    const uint8_t *b = (const uint8_t *)&seal;
    seal.check = evlcp_crc32(0u, b, sizeof seal - 4u);
    if (!hal_flash_write(slot_of(u->image), SEAL_AT, b, sizeof seal) || !has_valid_image(u->image, &seal))
        return EVLCP_STATUS_FLASH_FAULT;
    return evlcp_answer(x, &reply, sizeof reply);
}

enum evlcp_status on_update_restart(struct evlcp *e, struct exchange *x)
{
    (void)x;
    e->update.restart = true;
    e->update.restart_ms = hal_millis();
    return EVLCP_STATUS_OK;
}

enum evlcp_status on_update_confirm(struct evlcp *e, struct exchange *x)
{
    (void)e;
    (void)x;
    if (!is_on_trial() || clear_word((uint8_t)(hal_running_image() - 1u), CONFIRMED_AT))
        return EVLCP_STATUS_OK;
    return EVLCP_STATUS_FLASH_FAULT;
}
