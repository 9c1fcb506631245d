/* CRC-32/ISO-HDLC. */
#pragma once

#include <stdint.h>

/* CRC of `count` bytes after bytes whose CRC is `crc`; 0 to begin with. */
uint32_t evlcp_crc32(uint32_t crc, const uint8_t *bytes, uint32_t count);
