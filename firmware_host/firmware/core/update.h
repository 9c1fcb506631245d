/* Updates in the field: two places for images beside the one that was flashed, written in turn. A new image runs on
   trial: it must be confirmed before the third reset, or the one before it runs again. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#include "protocol.h"

#define EVLCP_IMAGES 2u
#define EVLCP_IMAGE_SLOT 2u /* flash slot of the first; those before are SAVE's */
#define EVLCP_IMAGE_SLOT_BYTES 65536u
#define EVLCP_IMAGE_BYTES (EVLCP_IMAGE_SLOT_BYTES - 64u)
#define EVLCP_TRIES 3u

struct evlcp_update {
    bool open; /* erased, to be written */
    uint8_t image;
    uint32_t length;
    uint32_t crc;
    bool restart;
    uint32_t restart_ms;
};

/* CRC-32 of a part of a flash slot. */
uint32_t evlcp_flash_crc(uint8_t slot, uint32_t offset, uint32_t length);

/* Which image to run after a reset, 1 or 2, or 0 for the one that was flashed; a trial's count goes down. Called
   once, before anything else, by the image that was flashed. */
uint8_t evlcp_update_pick_image(void);
