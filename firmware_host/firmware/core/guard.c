#include "guard.h"

#define WORDS_A_ROW 3u
#define COUNT_BITS 16u

_Static_assert(EVLCP_ROW_BYTES == 4u * WORDS_A_ROW, "rows are counted in words");

_Static_assert(1000u * EVLCP_BURST_MOST <= 0xffffu, "an excess is half a word");

/* Both halves of a word at once: the chip interrupt of a board does this 144 times a chip. */
#ifdef __ARM_FEATURE_DSP
#include <arm_acle.h>
#define ADD_HALVES(a, b) __uqadd16(a, b)
#define SUBTRACT_HALVES(a, b) __uqsub16(a, b)
#else
static uint32_t add_half(uint32_t a, uint32_t b)
{
    return a + b > 0xffffu ? 0xffffu : a + b;
}

static uint32_t subtract_half(uint32_t a, uint32_t b)
{
    return a > b ? a - b : 0u;
}
#define ADD_HALVES(a, b) (add_half((a) >> 16, (b) >> 16) << 16 | add_half((a) & 0xffffu, (b) & 0xffffu))
#define SUBTRACT_HALVES(a, b) \
    (subtract_half((a) >> 16, (b) >> 16) << 16 | subtract_half((a) & 0xffffu, (b) & 0xffffu))
#endif

static const uint32_t lit[4] = {0u, 1000u, 1000u << 16, 1000u << 16 | 1000u};

bool evlcp_guard_check_row(struct evlcp_guard *guard, const uint8_t row[EVLCP_ROW_BYTES])
{
    uint32_t duty = atomic_load(&guard->duty) * 0x10001u;
    uint32_t burst = guard->burst * 0x10001u;
    uint32_t beyond = 0u;
    uint32_t *excess = guard->excess;
    for (uint32_t i = 0; i < EVLCP_ROW_BYTES; i++, excess += 4) {
        uint32_t byte = row[i];
        excess[0] = SUBTRACT_HALVES(ADD_HALVES(excess[0], lit[byte >> 6]), duty);
        excess[1] = SUBTRACT_HALVES(ADD_HALVES(excess[1], lit[byte >> 4 & 3u]), duty);
        excess[2] = SUBTRACT_HALVES(ADD_HALVES(excess[2], lit[byte >> 2 & 3u]), duty);
        excess[3] = SUBTRACT_HALVES(ADD_HALVES(excess[3], lit[byte & 3u]), duty);
        beyond |= SUBTRACT_HALVES(excess[0], burst) | SUBTRACT_HALVES(excess[1], burst);
        beyond |= SUBTRACT_HALVES(excess[2], burst) | SUBTRACT_HALVES(excess[3], burst);
    }
    return beyond == 0u;
}

void evlcp_guard_add_dark(struct evlcp_guard *guard, uint32_t chips)
{
    uint32_t duty = atomic_load(&guard->duty);
    uint32_t gone = duty != 0u && chips > 0xffffu / duty ? 0xffffu : chips * duty;
    for (uint32_t i = 0; i < EVLCP_LEDS / 2u; i++)
        guard->excess[i] = SUBTRACT_HALVES(guard->excess[i], gone * 0x10001u);
}

static uint32_t count_ones(uint32_t word)
{
    uint32_t n = 0u;
    for (; word != 0u; word &= word - 1u)
        n++;
    return n;
}

/* The most that one of the LEDs, or clusters, is on, over `count` chips of a bit each: counters side by side, a bit
   of each in every word. */
static uint32_t most_chips_of_rows(const uint8_t *rows, uint32_t count, uint32_t bytes)
{
    uint32_t bits[COUNT_BITS][WORDS_A_ROW] = {{0}};
    uint32_t most = 0u;
    for (uint32_t n = 0; n < count; n++, rows += bytes) {
        for (uint32_t w = 0; 4u * w < bytes; w++) {
            uint32_t carry = 0u;
            if (bytes - 4u * w >= 4u) {
                carry = evlcp_get32(rows + 4u * w);
            } else {
                for (uint32_t i = 4u * w; i < bytes; i++)
                    carry = carry << 8 | rows[i];
            }
            for (uint32_t k = 0; carry != 0u && k < COUNT_BITS; k++) {
                uint32_t old = bits[k][w];
                bits[k][w] = old ^ carry;
                carry &= old;
            }
        }
    }
    for (uint32_t led = 0; led < EVLCP_LEDS; led++) {
        uint32_t on = 0u;
        for (uint32_t k = 0; k < COUNT_BITS; k++)
            on |= (bits[k][led / 32u] >> led % 32u & 1u) << k;
        most = on > most ? on : most;
    }
    return most;
}

static uint32_t most_chips_of_words(const struct evlcp_plan *plan, const uint8_t *words)
{
    const struct evlcp_setup *setup = &plan->setup;
    uint32_t pilots = ((uint32_t)setup->frames + setup->pilot_every - 1u) / setup->pilot_every;
    uint32_t frames = (uint32_t)plan->packets * setup->frames;
    uint32_t most = 0u;
    for (uint32_t k = 0; k < EVLCP_BOARD_CLUSTERS; k++) {
        uint32_t on = plan->packets * (count_ones(setup->preamble) + pilots * count_ones(setup->pilots[k]));
        for (uint32_t f = 0; f < frames; f++)
            on += count_ones(evlcp_get16(words + f * EVLCP_FRAME_BYTES + 2u * k));
        most = on > most ? on : most;
    }
    return most;
}

uint16_t evlcp_guard_duty(const struct evlcp_plan *plan, const uint8_t *content)
{
    uint32_t chips = plan->packets * plan->packet_chips / (plan->setup.hold != 0u ? plan->setup.hold : 1u);
    uint32_t on = plan->format == EVLCP_FORMAT_WORDS
                      ? most_chips_of_words(plan, content)
                      : most_chips_of_rows(content + plan->table_bytes, chips, plan->chip_bytes);
    return (uint16_t)((on * 1000u + chips - 1u) / chips);
}
