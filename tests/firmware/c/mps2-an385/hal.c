/* HAL of the emulated board: QEMU's mps2-an385 (Cortex-M3, 25 MHz).

   UART0 is the host's line. UART1 records the LED outputs: u32 tick, u32 chip, 12 bytes, little-endian.
   TIMER0 times the chips, TIMER1 runs free as tick counter. No WFI: under -icount the tick counter then counts
   executed instructions, and the same program gives the same trace. The flash slots are memory: they outlive
   nothing. The emulated line knows no rate; no level, temperature or open LED is there to measure. */
#include "evlcp.h"
#include "startup.h"

#define TICK_HZ 25000000u

#define TIMER0 0x40000000u
#define TIMER1 0x40001000u
#define TIMER_CTRL(t) REGISTER((t) + 0x0u)
#define TIMER_VALUE(t) REGISTER((t) + 0x4u)
#define TIMER_RELOAD(t) REGISTER((t) + 0x8u)
#define TIMER_INTCLEAR(t) REGISTER((t) + 0xcu)
#define TIMER_ENABLE 0x1u
#define TIMER_INTERRUPT 0x8u

#define UART0 0x40004000u
#define UART1 0x40005000u
#define UART_DATA(u) REGISTER((u) + 0x0u)
#define UART_STATE(u) REGISTER((u) + 0x4u)
#define UART_CTRL(u) REGISTER((u) + 0x8u)
#define UART_INTCLEAR(u) REGISTER((u) + 0xcu)
#define UART_BAUDDIV(u) REGISTER((u) + 0x10u)
#define UART_TXFULL 0x1u
#define UART_RXFULL 0x2u
#define UART_RXOVERRUN 0x8u
#define UART_TX 0x1u
#define UART_RX 0x2u
#define UART_RX_INTERRUPT 0x8u
#define UART_INT_RX 0x2u

#define IRQ_UART0_RX 0u
#define IRQ_TIMER0 8u

extern uint32_t link_stack[];

static struct evlcp board;
static uint8_t slots[EVLCP_SLOTS][EVLCP_SLOT_BYTES];
static uint32_t last_tick;
static uint32_t tick_rest;
static uint32_t millis;
static uint32_t lost;

static uint32_t ticks(void)
{
    return ~TIMER_VALUE(TIMER1);
}

void hal_info(struct evlcp_hal_info *info)
{
    *info = (struct evlcp_hal_info){
        .tick_hz = TICK_HZ,
        .ticks_per_chip_max = 0xffffffffu,
        .chip_rate_max_hz = 20000u,
        .level_max_ma = 60u,
        .level_default_ma = 20u,
        .mean_max_ma = 30u,
        .burst_chips = 64u,
        .clock_hz = 1000u,
        .capabilities = EVLCP_CAPABILITY_FLASH | EVLCP_CAPABILITY_LEVEL | EVLCP_CAPABILITY_RECORDS,
        .unique_id = "QEMU-AN385",
        .name = "mps2-an385"};
}

static void record(uint32_t byte)
{
    while ((UART_STATE(UART1) & UART_TXFULL) != 0u) {
    }
    UART_DATA(UART1) = byte & 0xffu;
}

void hal_leds(const uint8_t *row, uint32_t chip)
{
    uint32_t tick = ticks(); /* first: this is the moment of the output */
    for (uint32_t i = 0; i < 4u; i++)
        record(tick >> 8u * i);
    for (uint32_t i = 0; i < 4u; i++)
        record(chip >> 8u * i);
    for (uint32_t i = 0; i < EVLCP_ROW_BYTES; i++)
        record(row[i]);
}

void hal_chips(uint32_t count)
{
    TIMER_CTRL(TIMER0) = 0u;
    TIMER_INTCLEAR(TIMER0) = 1u;
    irq_forget(IRQ_TIMER0);
    if (count == 0u)
        return;
    TIMER_RELOAD(TIMER0) = count - 1u;
    TIMER_VALUE(TIMER0) = count - 1u;
    TIMER_CTRL(TIMER0) = TIMER_ENABLE | TIMER_INTERRUPT;
}

uint32_t hal_lateness(void)
{
    return TIMER_RELOAD(TIMER0) - TIMER_VALUE(TIMER0);
}

uint32_t hal_millis(void)
{
    /* Called far more often than the 171 s in which the tick counter wraps. */
    uint32_t tick = ticks();
    tick_rest += tick - last_tick;
    last_tick = tick;
    millis += tick_rest / (TICK_HZ / 1000u);
    tick_rest %= TICK_HZ / 1000u;
    return millis;
}

uint32_t hal_send(const uint8_t *bytes, uint32_t count)
{
    uint32_t sent = 0u;
    while (sent < count && (UART_STATE(UART0) & UART_TXFULL) == 0u)
        UART_DATA(UART0) = bytes[sent++];
    return sent;
}

bool hal_random(uint8_t *bytes, uint32_t count)
{
    (void)bytes;
    (void)count;
    return false;
}

uint32_t hal_lost(void)
{
    if ((UART_STATE(UART0) & UART_RXOVERRUN) != 0u) {
        UART_STATE(UART0) = UART_RXOVERRUN;
        lost++;
    }
    uint32_t since = lost;
    lost = 0u;
    return since;
}

bool hal_level(uint16_t level_ma)
{
    (void)level_ma;
    return true;
}

void hal_health(struct evlcp_health *health)
{
    *health = (struct evlcp_health){.temperature_dc = 250};
}

bool hal_flash_erase(uint8_t slot)
{
    for (uint32_t i = 0; i < EVLCP_SLOT_BYTES; i++)
        slots[slot][i] = 0xffu;
    return true;
}

bool hal_flash_write(uint8_t slot, uint32_t offset, const uint8_t *bytes, uint32_t count)
{
    for (uint32_t i = 0; i < count; i++)
        slots[slot][offset + i] &= bytes[i];
    return true;
}

bool hal_flash_read(uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t count)
{
    evlcp_copy(bytes, slots[slot] + offset, count);
    return true;
}

void hal_when(const struct evlcp_when *when)
{
    (void)when;
}

bool hal_pulse(struct evlcp_pulse *pulse)
{
    *pulse = (struct evlcp_pulse){.count = 0u};
    return true;
}

uint32_t hal_clock(void)
{
    return hal_millis();
}

uint8_t hal_running(void)
{
    return 0u;
}

void hal_restart(void)
{
}

void hal_panic(void)
{
    static const uint8_t dark[EVLCP_ROW_BYTES];
    TIMER_CTRL(TIMER0) = 0u;
    hal_leds(dark, EVLCP_CHIP_DARK);
}

static void chip_handler(void)
{
    TIMER_INTCLEAR(TIMER0) = 1u;
    evlcp_chip(&board);
}

static void receive_handler(void)
{
    UART_INTCLEAR(UART0) = UART_INT_RX;
    while ((UART_STATE(UART0) & UART_RXFULL) != 0u) {
        uint8_t byte = (uint8_t)UART_DATA(UART0);
        evlcp_receive(&board, &byte, 1u);
    }
}

int main(void)
{
    TIMER_RELOAD(TIMER1) = 0xffffffffu;
    TIMER_VALUE(TIMER1) = 0xffffffffu;
    TIMER_CTRL(TIMER1) = TIMER_ENABLE;
    UART_BAUDDIV(UART1) = 16u;
    UART_CTRL(UART1) = UART_TX;
    last_tick = ticks();
    evlcp_init(&board);
    irq_enable(IRQ_TIMER0, 0x00u); /* the highest: nothing delays a chip */
    irq_enable(IRQ_UART0_RX, 0x80u);
    UART_BAUDDIV(UART0) = TICK_HZ / EVLCP_BAUD;
    UART_CTRL(UART0) = UART_TX | UART_RX | UART_RX_INTERRUPT;
    /* QEMU asks the line for bytes only after a read of DATA. */
    (void)UART_DATA(UART0);
    for (;;)
        evlcp_poll(&board);
}

union vector {
    uint32_t *stack;
    void (*handler)(void);
};

__attribute__((section(".vectors"), used)) static const union vector vectors[16 + 32] = {
    {.stack = link_stack},     {.handler = reset_handler}, {.handler = fault_handler},
    {.handler = fault_handler}, {.handler = fault_handler}, {.handler = fault_handler},
    {.handler = fault_handler}, {.handler = fault_handler}, {.handler = fault_handler},
    {.handler = fault_handler}, {.handler = fault_handler}, {.handler = fault_handler},
    {.handler = fault_handler}, {.handler = fault_handler}, {.handler = fault_handler},
    {.handler = fault_handler},
    [16 + IRQ_UART0_RX] = {.handler = receive_handler},
    [16 + IRQ_TIMER0] = {.handler = chip_handler},
};
