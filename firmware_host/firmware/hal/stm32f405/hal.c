/* HAL of the driver board: STM32F405 at 168 MHz from a crystal of EVLCP_HSE_HZ, six 16-channel constant-current shift registers in a chain.

   | pin      | function                                             |
   |----------|------------------------------------------------------|
   | PA9 PA10 | USART1 to the host                                   |
   | PA5 PA7  | SPI1 clock and data of the chain                     |
   | PA6      | latch (LE), TIM3 channel 1                           |
   | PA4      | DAC 1: reference of the LED current                  |
   | PA0      | pulses, one a second or more, TIM2 channel 1; pulled |
   |          | down inside                                          |
   | PB0      | output enable of the drivers, high is dark; pulled up on the board, so dark through reset |
   | PB1      | thermal switch to ground, open when too hot; pulled  |
   |          | up inside, so a broken wire is too hot as well       |

   A chip of t ticks (a tick is 12 cycles) has six slots of 2 t cycles. At the end of each slot TIM1's update
   makes DMA2 stream 5 move one 16-bit word of the row to SPI1, which shifts it out in 1.5 us. TIM3 runs on the
   same clock, one period a chip, started by TIM1: it lifts the latch from 4 us to 5 us after the sixth word, when
   the chain is at rest. So the moment of a change is the hardware's; no instruction takes part in it.

   The stream goes round and round over two rows and interrupts after each: the core fills the row that has just
   gone. The other one is on its way already, for in direct mode the stream fetches a word ahead. So a row has a
   whole chip of time to be handed in, and is on show two chips later.

   In step with pulses a chip is nominally six cycles too short, and the chip interrupt stops TIM1 for as long as the
   chip before was early; TIM3 counts only while TIM1 runs then. So both stay together, and an error of the crystal of
   up to 350 ppm goes into the stops. TIM2 takes the time of each pulse by itself.

   Dark is output enable, a pin that needs neither the stream nor a timer. What sets it by itself, and when, is a table
   of docs/transmitter.md. SysTick is restarted by every chip; the main loop looks at SPI1, TIM3 and TIM2.

   Reset leaves PB0 an input: the pull-up on the board is what keeps the LEDs dark then. A board that comes from the
   watchdog's reset stays dark, with CHIP_LOST, until START, even if a slot says autostart. */
#include "evlcp.h"

#ifndef EVLCP_IMAGE
#define EVLCP_IMAGE 0u /* the one that is flashed; 1 and 2 come by updates */
#endif
#ifndef EVLCP_HSE_HZ
#define EVLCP_HSE_HZ 8000000u
#endif
#if EVLCP_HSE_HZ == 8000000u
#define EVLCP_TARGET "stm32f405-8mhz"
#else
#define EVLCP_TARGET "stm32f405-12mhz"
#endif

#define CORE_HZ 168000000u
#define HSI_HZ 16000000u
#define TICK_CYCLES 12u
#define SLOTS_PER_CHIP 6u
#define LATCH_AT_US 4u
#define LATCH_US 1u
#define TIM3_PER_US 84u

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define NVIC_ISER(n) REGISTER(0xe000e100u + 4u * (n))
#define NVIC_ICPR(n) REGISTER(0xe000e280u + 4u * (n))
#define NVIC_PRIORITY(irq) (*(volatile uint8_t *)(0xe000e400u + (irq)))

#define RCC 0x40023800u
#define RCC_CR REGISTER(RCC + 0x00u)
#define RCC_PLLCFGR REGISTER(RCC + 0x04u)
#define RCC_CFGR REGISTER(RCC + 0x08u)
#define RCC_CIR REGISTER(RCC + 0x0cu)
#define RCC_AHB1ENR REGISTER(RCC + 0x30u)
#define RCC_AHB2ENR REGISTER(RCC + 0x34u)
#define RCC_APB1ENR REGISTER(RCC + 0x40u)
#define RCC_APB2ENR REGISTER(RCC + 0x44u)
#define RCC_CSR REGISTER(RCC + 0x74u)
#define HSE_ON 0x00010000u
#define HSE_READY 0x00020000u
#define PLL_ON 0x01000000u
#define PLL_READY 0x02000000u
#define CLOCK_SECURITY_ON 0x00080000u
#define CLOCK_SECURITY_CLEAR 0x00800000u
#define RESET_FLAGS_CLEAR 0x01000000u
#define RESET_BY_IWDG 0x20000000u

#define IWDG 0x40003000u
#define IWDG_KR REGISTER(IWDG + 0x0u)
#define IWDG_PR REGISTER(IWDG + 0x4u)
#define IWDG_RLR REGISTER(IWDG + 0x8u)
#define IWDG_SR REGISTER(IWDG + 0xcu)
#define IWDG_START 0xccccu
#define IWDG_UNLOCK 0x5555u
#define IWDG_FEED 0xaaaau
#define IWDG_BY_32 3u      /* counts of a millisecond, by an LSI of 17 to 47 kHz of 0.7 to 1.9 ms */
#define IWDG_SHORT 100u
#define IWDG_LONG 4095u    /* while a sector is erased, or at 16 MHz: the LEDs are dark then */

#define PWR_CR REGISTER(0x40007000u)
#define PWR_CSR REGISTER(0x40007004u)
#define PWR_SCALE_1 0x00004000u /* the regulator for 168 MHz; without it 144 MHz at most */
#define PVD_2V8 0x000000d0u     /* level 6, on */
#define PVD_LOW 0x4u
#define EXTI 0x40013c00u
#define EXTI_IMR REGISTER(EXTI + 0x00u)
#define EXTI_RTSR REGISTER(EXTI + 0x08u)
#define EXTI_PR REGISTER(EXTI + 0x14u)
#define EXTI_PVD 0x00010000u

#define RNG 0x50060800u
#define RNG_CR REGISTER(RNG + 0x0u)
#define RNG_SR REGISTER(RNG + 0x4u)
#define RNG_DR REGISTER(RNG + 0x8u)
#define RNG_ON 0x4u
#define RNG_READY 0x1u
#define RNG_ERRORS 0x66u /* clock or seed, now or since */

#define SYSTICK_CSR REGISTER(0xe000e010u)
#define SYSTICK_RVR REGISTER(0xe000e014u)
#define SYSTICK_CVR REGISTER(0xe000e018u)
#define SYSTICK_ON 0x7u /* core clock, exception */
#define SCB_ICSR REGISTER(0xe000ed04u)
#define SYSTICK_FORGET 0x02000000u
#define SCB_VTOR REGISTER(0xe000ed08u)
#define SCB_AIRCR REGISTER(0xe000ed0cu)
#define SCB_RESET 0x05fa0004u

#define FLASH 0x40023c00u
#define FLASH_ACR REGISTER(FLASH + 0x00u)
#define FLASH_KEYR REGISTER(FLASH + 0x04u)
#define FLASH_SR REGISTER(FLASH + 0x0cu)
#define FLASH_CR REGISTER(FLASH + 0x10u)
#define FLASH_LATENCY_5 0x005u
#define FLASH_PREFETCH 0x100u
#define FLASH_CACHES 0x600u /* instructions and data */
#define FLASH_CACHES_RESET 0x1800u
#define FLASH_BUSY 0x00010000u
#define FLASH_ERRORS 0x000000f2u
#define FLASH_PROGRAM 0x00000001u
#define FLASH_SECTOR_ERASE 0x00000002u
#define FLASH_WORDS 0x00000200u
#define FLASH_START 0x00010000u
#define FLASH_LOCK 0x80000000u

#define GPIOA 0x40020000u
#define GPIOB 0x40020400u
#define GPIO_MODER(p) REGISTER((p) + 0x00u)
#define GPIO_OSPEEDR(p) REGISTER((p) + 0x08u)
#define GPIO_PUPDR(p) REGISTER((p) + 0x0cu)
#define GPIO_IDR(p) REGISTER((p) + 0x10u)
#define GPIO_BSRR(p) REGISTER((p) + 0x18u)
#define GPIO_AFRL(p) REGISTER((p) + 0x20u)
#define GPIO_AFRH(p) REGISTER((p) + 0x24u)
#define PIN(n) (1u << (n))
#define PIN_CLEAR(n) (1u << ((n) + 16u))
#define MODE(n, m) ((uint32_t)(m) << 2u * (n))
#define MODE_OUTPUT 1u
#define MODE_ALTERNATE 2u
#define MODE_ANALOG 3u

#define USART1 0x40011000u
#define USART_SR REGISTER(USART1 + 0x00u)
#define USART_DR REGISTER(USART1 + 0x04u)
#define USART_BRR REGISTER(USART1 + 0x08u)
#define USART_CR1 REGISTER(USART1 + 0x0cu)
#define USART_OVERRUN 0x08u
#define USART_RECEIVED 0x20u
#define USART_EMPTY 0x80u

#define SPI1 0x40013000u
#define SPI_CR1 REGISTER(SPI1 + 0x00u)
#define SPI_CR2 REGISTER(SPI1 + 0x04u)
#define SPI_SR REGISTER(SPI1 + 0x08u)
#define SPI_DR REGISTER(SPI1 + 0x0cu)
#define SPI_EMPTY 0x02u
#define SPI_BUSY 0x80u
#define SPI_ON 0x40u

#define TIM1 0x40010000u
#define TIM2 0x40000000u
#define TIM3 0x40000400u
#define TIM_CR1(t) REGISTER((t) + 0x00u)
#define TIM_CR2(t) REGISTER((t) + 0x04u)
#define TIM_SMCR(t) REGISTER((t) + 0x08u)
#define TIM_DIER(t) REGISTER((t) + 0x0cu)
#define TIM_SR(t) REGISTER((t) + 0x10u)
#define TIM_EGR(t) REGISTER((t) + 0x14u)
#define TIM_CCMR1(t) REGISTER((t) + 0x18u)
#define TIM_CCER(t) REGISTER((t) + 0x20u)
#define TIM_CNT(t) REGISTER((t) + 0x24u)
#define TIM_PSC(t) REGISTER((t) + 0x28u)
#define TIM_ARR(t) REGISTER((t) + 0x2cu)
#define TIM_CCR1(t) REGISTER((t) + 0x34u)
#define TIM_CAPTURED 0x2u

#define DMA2 0x40026400u
#define DMA_HISR REGISTER(DMA2 + 0x04u)
#define DMA_HIFCR REGISTER(DMA2 + 0x0cu)
#define DMA_S5CR REGISTER(DMA2 + 0x88u)
#define DMA_S5NDTR REGISTER(DMA2 + 0x8cu)
#define DMA_S5PAR REGISTER(DMA2 + 0x90u)
#define DMA_S5M0AR REGISTER(DMA2 + 0x94u)
#define DMA_S5FCR REGISTER(DMA2 + 0x9cu)
#define DMA_ENABLE 0x1u
#define DMA_S5_HALF 0x00000400u
#define DMA_S5_ALL 0x00000800u
#define DMA_S5_ERRORS 0x00000340u /* transfer, direct mode, FIFO */
#define DMA_S5_FLAGS 0x00000f40u
#define DMA_ERROR_INTERRUPTS 0x6u /* transfer, direct mode */
#define DMA_FIFO_INTERRUPT 0x80u

#define DAC_CR REGISTER(0x40007400u)
#define DAC_DHR12R1 REGISTER(0x40007408u)

#define UNIQUE_ID 0x1fff7a10u
/* Sectors of 128 KiB: two of SAVE, then two for images of updates. */
#define SLOT_SECTOR(slot) ((slot) < EVLCP_IMAGE_SLOT ? 10u + (slot) : 6u + (slot) - EVLCP_IMAGE_SLOT)
#define SLOT_ADDRESS(slot) (0x08000000u + 0x20000u * (SLOT_SECTOR(slot) - 4u))

#define IRQ_PVD 1u
#define IRQ_USART1 37u
#define IRQ_DMA2_STREAM5 68u

#define LEVEL_MAX_MA 60u
#define MEAN_MAX_MA 30u
#define DAC_FULL 4095u
#define WAIT_LOOPS 1000000u
#define WORD_WAIT_LOOPS 1000u /* a word is on its way for 1.5 us; a stream ends with the one under way */
#define PULSE_FITS 3000u /* a pulse may be off by that share of its distance */
#define STEP_LEAST 8     /* counts of TIM2; a stop takes some itself */
#define STEP_MOST 1680   /* 20 us: more is no error of a crystal */
#define LOOKS_MIN 16u        /* longer than a word is on its way to the chain */

extern uint32_t link_stack[];
extern uint32_t link_data_load[];
extern uint32_t link_data_start[];
extern uint32_t link_data_end[];
extern uint32_t link_bss_start[];
extern uint32_t link_bss_end[];

static struct evlcp board;
static volatile uint16_t words[2][SLOTS_PER_CHIP]; /* two rows on their way to the chain */
static uint32_t gone;                              /* the row that may be filled */
static volatile bool clock_failed;
static volatile bool in_chip;      /* the chip interrupt runs the core */
static volatile uint32_t draining; /* chips until the chain is at rest after the core has stopped */
static volatile uint32_t served;   /* chip interrupts since the start, up to 2 */
static bool overrun;               /* the chip interrupt missed a row */
static volatile bool streaming;    /* TIM1 and the stream are to run */
static volatile bool failed;       /* went dark by itself; yet to be reported to the core */
/* Where chips should be, in counts of TIM2: `step_chip` begins at `step_at`, a chip takes `step_counts` / 65536. The
   main loop writes it with `step_on` false. */
static volatile bool step_on;
static volatile uint32_t step_at;
static volatile uint32_t step_chip;
static volatile uint64_t step_counts;
static uint32_t step_served; /* chip interrupts since the start */
static bool in_step;
static bool waits; /* the next chips begin at `when` */
static bool pulse_fits;
static struct evlcp_when when;
static struct evlcp_pulse pulse;
static volatile uint32_t chip_at;  /* TIM2 at the latest chip interrupt */
static uint32_t slot_cycles;
static uint32_t last_count;
static uint32_t count_rest;
static uint32_t millis;
static volatile uint32_t lost;
static uint32_t reported_lost;

void hal_get_info(struct evlcp_hal_info *info)
{
    *info = (struct evlcp_hal_info){.tick_hz = CORE_HZ / TICK_CYCLES,
                                    .ticks_per_chip_max = 65536u / SLOTS_PER_CHIP,
                                    .chip_rate_max_hz = 20000u,
                                    .level_max_ma = LEVEL_MAX_MA,
                                    .level_default_ma = 20u,
                                    .mean_max_ma = MEAN_MAX_MA,
                                    .burst_chips = 64u,
                                    .capabilities = EVLCP_CAPABILITY_FLASH | EVLCP_CAPABILITY_LEVEL |
                                                    EVLCP_CAPABILITY_UPDATE | EVLCP_CAPABILITY_PULSE,
                                    .name = "stm32f405",
                                    .target = EVLCP_TARGET,
                                    .clock_hz = CORE_HZ / 2u};
    evlcp_copy(info->unique_id, (const uint8_t *)UNIQUE_ID, sizeof info->unique_id);
}

static void irq_enable(uint32_t irq, uint8_t priority)
{
    NVIC_PRIORITY(irq) = priority;
    NVIC_ISER(irq / 32u) = 1u << irq % 32u;
}

static void outputs_off(void)
{
    GPIO_BSRR(GPIOB) = PIN(0);
}

/* LED 0 leaves first and ends at the far end of the chain: it is output 15 of the last register. */
static void load(const uint8_t *row)
{
    for (uint32_t i = 0; i < SLOTS_PER_CHIP; i++)
        words[gone][i] = (uint16_t)(row[2u * i] << 8 | row[2u * i + 1u]);
}

/* Dark first: nothing of what follows is sure to work. */
static void chips_stop(void)
{
    outputs_off();
    streaming = false;
    SYSTICK_CSR = 0u;
    step_on = false;
    in_step = false;
    TIM_CR1(TIM1) = 0u;
    TIM_DIER(TIM1) = 0u; /* or an update would ask for a word that the next stream hands out */
    TIM_CR1(TIM3) = 0u;
    DMA_S5CR = 0u;
    for (uint32_t n = 0; n < WORD_WAIT_LOOPS && (DMA_S5CR & DMA_ENABLE) != 0u; n++) {
    }
    DMA_HIFCR = DMA_S5_FLAGS;
    SCB_ICSR = SYSTICK_FORGET;
    NVIC_ICPR(IRQ_DMA2_STREAM5 / 32u) = 1u << IRQ_DMA2_STREAM5 % 32u;
    __asm volatile("dsb\n isb" ::: "memory");
}

static void report_chip_fault(void)
{
    failed = true;
    chips_stop();
}

static void outputs_on(void)
{
    if ((PWR_CSR & PVD_LOW) != 0u) { /* the PVD interrupts when the supply falls, not while it is low */
        report_chip_fault();
        return;
    }
    GPIO_BSRR(GPIOB) = PIN_CLEAR(0);
    if (failed) /* just now, by an interrupt */
        outputs_off();
}

/* Shift a row out by hand while no chips run: the single-LED test. False if SPI1 does not follow. */
static bool shift_now(void)
{
    for (uint32_t i = 0; i < SLOTS_PER_CHIP; i++) {
        for (uint32_t n = 0; n < WORD_WAIT_LOOPS && (SPI_SR & SPI_EMPTY) == 0u; n++) {
        }
        SPI_DR = words[gone][i];
    }
    for (uint32_t n = 0; n < WORD_WAIT_LOOPS && (SPI_SR & SPI_BUSY) != 0u; n++) {
    }
    if ((SPI_SR & (SPI_EMPTY | SPI_BUSY)) != SPI_EMPTY)
        return false;
    GPIO_MODER(GPIOA) = (GPIO_MODER(GPIOA) & ~MODE(6, 3)) | MODE(6, MODE_OUTPUT);
    GPIO_BSRR(GPIOA) = PIN(6);
    GPIO_BSRR(GPIOA) = PIN(6); /* a second write: the latch pulse is longer than the drivers' 20 ns */
    GPIO_BSRR(GPIOA) = PIN_CLEAR(6);
    return true;
}

/* Progress of something that must not stop, as the main loop checks it. */
struct progress {
    uint32_t good_at;
    uint32_t bad;
};

static bool has_stalled(struct progress *progress, bool good, uint32_t now, uint32_t most)
{
    if (good || progress->bad == 0u) {
        progress->good_at = now;
        progress->bad = good ? 0u : 1u;
        return false;
    }
    progress->bad++;
    return progress->bad > LOOKS_MIN && now - progress->good_at > most;
}

static struct progress spi_progress;
static struct progress latch_progress;
static uint32_t latch_count;
static bool latch_seen; /* it has counted since the start */

/* Called without pause while chips may run. */
static void check_chip_progress(void)
{
    uint32_t at = chip_at; /* before the count: a chip in between makes it no older */
    uint32_t now = TIM_CNT(TIM2);
    uint32_t most = SLOTS_PER_CHIP * slot_cycles / 2u * 3u / 2u; /* 1.5 chips of TIM2, at half the core clock */
    if (!streaming)
        return;
    bool bad = now - at > most;
    bool spi_moves = (SPI_SR & (SPI_EMPTY | SPI_BUSY)) == SPI_EMPTY && (SPI_CR1 & SPI_ON) != 0u;
    bad |= has_stalled(&spi_progress, spi_moves, now, most);
    uint32_t count = TIM_CNT(TIM3);
    latch_seen |= count != latch_count;
    bad |= has_stalled(&latch_progress, count != latch_count || !latch_seen, now, most);
    latch_count = count;
    if (bad && streaming) /* it may have ended meanwhile */
        report_chip_fault();
}

/* Wait until the rows that the core has ended with have left the chain: at most three chips, and none after a fault. */
static void wait_until_drained(void)
{
    while (draining != 0u && streaming)
        check_chip_progress();
}

void hal_show_leds(const uint8_t *row, uint32_t chip)
{
    if (chip == EVLCP_CHIP_TEST)
        wait_until_drained();
    if (chip == EVLCP_CHIP_DARK && !in_chip) {
        outputs_off();
        return;
    }
    load(row);
    if (chip == EVLCP_CHIP_TEST) {
        if (shift_now())
            outputs_on();
        else
            report_chip_fault();
    }
}

/* Plan the times of chips from the latest pulse. */
static void plan_steps(void)
{
    uint32_t each = when.chip_rate_hz / when.pulse_hz;
    step_on = false;
    step_at = pulse.at;
    step_chip = (pulse.count - when.pulse) * each;
    step_counts = ((uint64_t)pulse.between << 16) / each;
    step_on = true;
}

/* In the chip interrupt: stop TIM1 for as long as this chip is early. */
static void step_chip_clock(void)
{
    step_served++;
    uint32_t slot = (2u * SLOTS_PER_CHIP - DMA_S5NDTR) % SLOTS_PER_CHIP;
    if (!step_on || slot != 0u)
        return; /* planned anew, or so late that the place is unsure: the next one does it */
    int64_t chips = (int64_t)(int32_t)(step_served - step_chip);
    uint32_t should = step_at + (uint32_t)(int32_t)(chips * (int64_t)step_counts >> 16);
    int32_t early = (int32_t)(should + TIM_CNT(TIM1) / 2u - TIM_CNT(TIM2));
    if (early < STEP_LEAST || early > STEP_MOST)
        return;
    TIM_CR1(TIM1) = 0u;
    uint32_t from = TIM_CNT(TIM2);
    while (TIM_CNT(TIM2) - from < (uint32_t)early) {
    }
    TIM_CR1(TIM1) = 1u;
}

static void chips_start(uint32_t ticks)
{
    slot_cycles = TICK_CYCLES / SLOTS_PER_CHIP * ticks;
    in_step = waits && when.pulse != 0u;
    if (in_step)
        slot_cycles -= 1u;
    static const uint8_t dark[EVLCP_ROW_BYTES];
    for (gone = 0u; gone < 2u; gone++)
        load(dark);
    gone = 0u;
    served = 0u;
    draining = 0u; /* a fault may have come just before the core ended */
    overrun = false;
    GPIO_MODER(GPIOA) = (GPIO_MODER(GPIOA) & ~MODE(6, 3)) | MODE(6, MODE_ALTERNATE);

    /* TIM1: a slot; its update asks for a word, its start lets TIM3 go. */
    TIM_CR2(TIM1) = 0x10u; /* TRGO is the enable bit */
    TIM_PSC(TIM1) = 0u;
    TIM_ARR(TIM1) = slot_cycles - 1u;
    TIM_DIER(TIM1) = 0u;
    TIM_EGR(TIM1) = 1u; /* an update too, which must not ask for a word */
    TIM_SR(TIM1) = 0u;
    TIM_DIER(TIM1) = 0x100u; /* update -> DMA */

    /* TIM3: a chip, at half TIM1's clock; counter 0 is the latch. The words go at the ends of slots 1 to 6, so the
       sixth is six slots after the start, and the latch LATCH_AT_US after that. The first time round, the counter
       starts so that it wraps then. */
    uint32_t chip_counts = SLOTS_PER_CHIP * slot_cycles / 2u;
    TIM_PSC(TIM3) = 0u;
    TIM_ARR(TIM3) = chip_counts - 1u;
    TIM_CCR1(TIM3) = LATCH_US * TIM3_PER_US;
    TIM_CCMR1(TIM3) = 0x60u; /* PWM mode 1: high below CCR1 */
    TIM_CCER(TIM3) = 1u;
    TIM_EGR(TIM3) = 1u;
    TIM_CNT(TIM3) = chip_counts - LATCH_AT_US * TIM3_PER_US;
    TIM_SMCR(TIM3) = 0x06u; /* started by ITR0 = TIM1 */
    if (in_step) {
        TIM_SMCR(TIM3) = 0x05u; /* counts while TIM1 does */
        TIM_CR1(TIM3) = 1u;
    }

    DMA_HIFCR = DMA_S5_FLAGS;
    DMA_S5PAR = SPI1 + 0x0cu;
    DMA_S5M0AR = (uint32_t)(uintptr_t)words;
    DMA_S5NDTR = 2u * SLOTS_PER_CHIP;
    /* Channel 6 (TIM1_UP), very high priority, 16 bits both sides, memory counts up, circular, memory to
       peripheral, interrupts when half and when all have gone. */
    DMA_S5CR = 6u << 25 | 3u << 16 | 1u << 13 | 1u << 11 | 1u << 10 | 1u << 8 | 1u << 6 | 1u << 4 | 1u << 3;
    DMA_S5FCR = DMA_FIFO_INTERRUPT;
    DMA_S5CR |= DMA_ERROR_INTERRUPTS | DMA_ENABLE;

    SYSTICK_RVR = SLOTS_PER_CHIP * slot_cycles * 3u / 2u - 1u;
    SYSTICK_CVR = 0u;
    spi_progress.bad = 0u;
    latch_progress.bad = 0u;
    latch_seen = false;
    latch_count = TIM_CNT(TIM3);
    step_served = 0u;
    if (waits) {
        waits = false;
        /* Not for ever: the core calls this EVLCP_START_LEAD_US before, or late. */
        while ((int32_t)(when.at - TIM_CNT(TIM2)) > 0 && !failed) {
        }
    }
    chip_at = TIM_CNT(TIM2);
    streaming = true;
    SYSTICK_CSR = SYSTICK_ON;
    TIM_CR1(TIM1) = 1u;
    if (in_step)
        plan_steps();
}

void hal_set_chip_clock(uint32_t ticks)
{
    if (ticks == 0u && in_chip) {
        /* The last row goes next, and stays its chip; the dark row follows, then rest. */
        draining = 3u;
        return;
    }
    if (ticks == 0u) {
        chips_stop();
        return;
    }
    wait_until_drained();
    if (!failed)
        chips_start(ticks);
}

void hal_schedule_start(const struct evlcp_when *at)
{
    when = *at;
    waits = true;
    pulse_fits = true;
}

uint32_t hal_clock(void)
{
    return TIM_CNT(TIM2);
}

/* A pulse may be missing; one that comes at another time than a whole number of them is none. */
static void take_pulse(uint32_t at)
{
    uint32_t between = at - pulse.at;
    uint32_t periods = 1u;
    if (in_step) {
        uint32_t nominal = CORE_HZ / 2u / when.pulse_hz;
        periods = (between + nominal / 2u) / nominal;
        uint32_t off = between > periods * nominal ? between - periods * nominal : periods * nominal - between;
        if (periods == 0u || off > periods * (nominal / PULSE_FITS)) {
            pulse_fits = false;
            return;
        }
        between /= periods;
    }
    pulse.between = pulse.count != 0u ? between : 0u;
    pulse.count += periods;
    pulse.at = at;
    if (in_step)
        plan_steps();
}

bool hal_read_pulse(struct evlcp_pulse *found)
{
    if ((TIM_SR(TIM2) & TIM_CAPTURED) != 0u)
        take_pulse(TIM_CCR1(TIM2)); /* the read clears the flag */
    *found = pulse;
    if (in_step && TIM_CNT(TIM2) - pulse.at > CORE_HZ / 2u / when.pulse_hz * 3u / 2u)
        pulse_fits = false;
    return !in_step || pulse_fits;
}

uint32_t hal_lateness(void)
{
    uint32_t moved = (2u * SLOTS_PER_CHIP - DMA_S5NDTR) % SLOTS_PER_CHIP;
    if (overrun)
        moved += SLOTS_PER_CHIP;
    return (moved * slot_cycles + TIM_CNT(TIM1)) / TICK_CYCLES;
}

uint32_t hal_millis(void)
{
    /* Called far more often than the 51 s in which TIM2 wraps. */
    uint32_t per_ms = (clock_failed ? HSI_HZ : CORE_HZ / 2u) / 1000u;
    uint32_t count = TIM_CNT(TIM2);
    count_rest += count - last_count;
    last_count = count;
    millis += count_rest / per_ms;
    count_rest %= per_ms;
    return millis;
}

uint32_t hal_send(const uint8_t *bytes, uint32_t count)
{
    uint32_t sent = 0u;
    while (sent < count && (USART_SR & USART_EMPTY) != 0u)
        USART_DR = bytes[sent++];
    return sent;
}

bool hal_random(uint8_t *bytes, uint32_t count)
{
    for (uint32_t i = 0; i < count; i += 4u) {
        /* A word takes 40 cycles of 48 MHz. */
        uint32_t n = 0u;
        while ((RNG_SR & RNG_READY) == 0u && n < WAIT_LOOPS / 1000u)
            n++;
        if ((RNG_SR & RNG_ERRORS) != 0u || (RNG_SR & RNG_READY) == 0u)
            return false;
        uint32_t word = RNG_DR;
        for (uint32_t j = i; j < i + 4u && j < count; j++)
            bytes[j] = (uint8_t)(word >> 8u * (j - i));
    }
    return true;
}

uint32_t hal_lost_bytes(void)
{
    uint32_t total = lost;
    uint32_t since = total - reported_lost;
    reported_lost = total;
    return since;
}

bool hal_set_level(uint16_t level_ma)
{
    DAC_DHR12R1 = level_ma * DAC_FULL / LEVEL_MAX_MA;
    return true;
}

void hal_read_health(struct evlcp_health *health)
{
    *health = (struct evlcp_health){.temperature_dc = INT16_MIN};
    if ((GPIO_IDR(GPIOB) & PIN(1)) != 0u)
        health->faults |= EVLCP_FAULT_OVER_TEMPERATURE;
    if (clock_failed)
        health->faults |= EVLCP_FAULT_CLOCK;
}

static bool flash_done(void)
{
    /* A sector takes up to two seconds to erase. */
    for (uint32_t n = 0; n < 100u * WAIT_LOOPS && (FLASH_SR & FLASH_BUSY) != 0u; n++) {
    }
    return (FLASH_SR & (FLASH_BUSY | FLASH_ERRORS)) == 0u;
}

static void flash_unlock(void)
{
    FLASH_KEYR = 0x45670123u;
    FLASH_KEYR = 0xcdef89abu;
    FLASH_SR = FLASH_ERRORS;
}

static void iwdg_reload(uint32_t counts)
{
    IWDG_KR = IWDG_UNLOCK;
    IWDG_PR = IWDG_BY_32;
    IWDG_RLR = counts;
    for (uint32_t n = 0; n < WAIT_LOOPS && IWDG_SR != 0u; n++) { /* some periods of the LSI */
    }
    IWDG_KR = IWDG_FEED;
}

/* What the caches hold of an erased sector is stale. */
static void flash_forget(void)
{
    uint32_t acr = FLASH_ACR;
    FLASH_ACR = acr & ~FLASH_CACHES; /* they are reset while they are off */
    FLASH_ACR = (acr & ~FLASH_CACHES) | FLASH_CACHES_RESET;
    FLASH_ACR = acr & ~FLASH_CACHES;
    FLASH_ACR = acr;
}

bool hal_flash_erase(uint8_t slot)
{
    wait_until_drained(); /* the core stands while a sector is erased, and no chip may come then */
    iwdg_reload(IWDG_LONG);
    flash_unlock();
    FLASH_CR = FLASH_WORDS | FLASH_SECTOR_ERASE | SLOT_SECTOR(slot) << 3;
    FLASH_CR |= FLASH_START;
    bool done = flash_done();
    FLASH_CR = FLASH_LOCK;
    flash_forget();
    iwdg_reload(clock_failed ? IWDG_LONG : IWDG_SHORT);
    return done;
}

bool hal_flash_write(uint8_t slot, uint32_t offset, const uint8_t *bytes, uint32_t count)
{
    bool good = true;
    flash_unlock();
    FLASH_CR = FLASH_WORDS | FLASH_PROGRAM;
    for (uint32_t i = 0; good && i < count; i += 4u) {
        uint8_t last[4] = {0xff, 0xff, 0xff, 0xff};
        evlcp_copy(last, bytes + i, count - i < 4u ? count - i : 4u);
        REGISTER(SLOT_ADDRESS(slot) + offset + i) = evlcp_get32(last);
        good = flash_done();
        IWDG_KR = IWDG_FEED; /* 48 KiB take longer than it waits */
    }
    FLASH_CR = FLASH_LOCK;
    return good;
}

void hal_flash_read(uint8_t slot, uint32_t offset, uint8_t *bytes, uint32_t count)
{
    evlcp_copy(bytes, (const uint8_t *)(SLOT_ADDRESS(slot) + offset), count);
    IWDG_KR = IWDG_FEED; /* at 16 MHz two images are checked for longer than it waits */
}

uint8_t hal_running_image(void)
{
    return EVLCP_IMAGE;
}

void hal_restart(void)
{
    outputs_off();
    SCB_AIRCR = SCB_RESET;
    for (;;) { /* or the watchdog does it */
    }
}

/* The image that was flashed hands over to an update. The watchdog runs before: an update that hangs is left. */
static void hand_over(void)
{
    uint8_t image = EVLCP_IMAGE == 0u ? evlcp_update_pick_image() : 0u;
    if (image == 0u)
        return;
    IWDG_KR = IWDG_START;
    iwdg_reload(IWDG_SHORT);
    uint32_t base = SLOT_ADDRESS(EVLCP_IMAGE_SLOT + image - 1u);
    SCB_VTOR = base;
    __asm volatile("dsb\n isb\n msr msp, %0\n bx %1" ::"r"(REGISTER(base)), "r"(REGISTER(base + 4u)));
}

/* Every exception that should not happen: dark, then nothing more. */
static void fault_handler(void)
{
    chips_stop();
    for (;;) {
    }
}

static void silence_handler(void)
{
    if (streaming)
        report_chip_fault();
}

/* Clock security: the crystal has stopped, and the core runs on the 16 MHz RC oscillator. */
static void clock_handler(void)
{
    outputs_off();
    RCC_CIR |= CLOCK_SECURITY_CLEAR;
    clock_failed = true;
    report_chip_fault();
    RCC_CFGR = 0u; /* buses undivided: the host's line rate can be kept */
    USART_BRR = HSI_HZ / EVLCP_BAUD;
    IWDG_KR = IWDG_UNLOCK;
    IWDG_RLR = IWDG_LONG;
}

static void supply_handler(void)
{
    EXTI_PR = EXTI_PVD;
    report_chip_fault();
}

static void chip_handler(void)
{
    static const uint8_t dark[EVLCP_ROW_BYTES];
    SYSTICK_CVR = 0u;
    chip_at = TIM_CNT(TIM2);
    uint32_t flags = DMA_HISR & DMA_S5_FLAGS;
    DMA_HIFCR = DMA_S5_FLAGS;
    if (!streaming) /* chips_stop was under way */
        return;
    if ((flags & DMA_S5_ERRORS) != 0u || (DMA_S5CR & DMA_ENABLE) == 0u) {
        report_chip_fault();
        return;
    }
    gone = flags == DMA_S5_HALF ? 0u : 1u;
    overrun = flags == (DMA_S5_HALF | DMA_S5_ALL);
    /* The first row shifted was dark; once it is latched the outputs may be let on. */
    if (served == 1u)
        outputs_on();
    if (served < 2u)
        served++;
    if (in_step)
        step_chip_clock();
    if (draining != 0u) {
        if (draining == 1u) {
            outputs_off();
            chips_stop();
        } else {
            load(dark);
            draining--;
        }
        return;
    }
    in_chip = true;
    evlcp_chip(&board);
    in_chip = false;
}

static void receive_handler(void)
{
    uint32_t status = USART_SR;
    if ((status & USART_OVERRUN) != 0u)
        lost++;
    if ((status & (USART_RECEIVED | USART_OVERRUN)) != 0u) {
        uint8_t byte = (uint8_t)USART_DR; /* the read clears both flags */
        if ((status & USART_RECEIVED) != 0u)
            evlcp_receive(&board, &byte, 1u);
    }
}

static bool wait_for_bits(const volatile uint32_t *where, uint32_t mask, uint32_t value)
{
    for (uint32_t n = 0; n < WAIT_LOOPS; n++) {
        if ((*where & mask) == value)
            return true;
        IWDG_KR = IWDG_FEED; /* an update starts with it running, and a dead crystal is waited for longer */
    }
    return false;
}

/* Crystal -> 1 MHz -> PLL -> 168 MHz; buses at 42 and 84 MHz. False: still on the 16 MHz RC oscillator. */
static bool clock_start(void)
{
    RCC_CR |= HSE_ON;
    if (!wait_for_bits(&RCC_CR, HSE_READY, HSE_READY))
        return false;
    FLASH_ACR = FLASH_CACHES | FLASH_PREFETCH | FLASH_LATENCY_5;
    RCC_PLLCFGR = 7u << 24 | 1u << 22 | 336u << 6 | EVLCP_HSE_HZ / 1000000u;
    RCC_CR |= PLL_ON;
    if (!wait_for_bits(&RCC_CR, PLL_READY, PLL_READY))
        return false;
    RCC_CFGR = 5u << 10 | 4u << 13; /* APB1 by 4, APB2 by 2 */
    RCC_CFGR |= 2u;
    if (!wait_for_bits(&RCC_CFGR, 0xcu, 8u))
        return false;
    RCC_CR |= CLOCK_SECURITY_ON;
    return true;
}

static void pins_start(void)
{
    RCC_AHB1ENR |= 1u << 22 | 1u << 1 | 1u << 0;             /* DMA2, GPIOB, GPIOA */
    RCC_AHB2ENR |= 1u << 6;                                  /* RNG */
    RCC_APB1ENR |= 1u << 29 | 1u << 28 | 1u << 1 | 1u << 0;  /* DAC, PWR, TIM3, TIM2 */
    RCC_APB2ENR |= 1u << 12 | 1u << 4 | 1u << 0;             /* SPI1, USART1, TIM1 */
    GPIO_BSRR(GPIOB) = PIN(0);                               /* dark before the pin drives */
    GPIO_MODER(GPIOB) |= MODE(0, MODE_OUTPUT);
    GPIO_PUPDR(GPIOB) |= 1u << 2;                            /* PB1 up */
    GPIO_AFRL(GPIOA) = 1u | 5u << 20 | 2u << 24 | 5u << 28;  /* TIM2, SPI1, TIM3, SPI1 */
    GPIO_PUPDR(GPIOA) |= 2u;                                 /* PA0 down */
    GPIO_AFRH(GPIOA) = 7u << 4 | 7u << 8;                    /* USART1 */
    GPIO_OSPEEDR(GPIOA) |= MODE(5, 2) | MODE(6, 2) | MODE(7, 2);
    GPIO_PUPDR(GPIOA) |= 1u << 20;                           /* PA10 up: an open line is idle */
    GPIO_MODER(GPIOA) |= MODE(0, MODE_ALTERNATE) | MODE(4, MODE_ANALOG) | MODE(5, MODE_ALTERNATE) | MODE(6, MODE_ALTERNATE) |
                         MODE(7, MODE_ALTERNATE) | MODE(9, MODE_ALTERNATE) | MODE(10, MODE_ALTERNATE);
}

int main(void)
{
    hand_over();
    bool by_watchdog = (RCC_CSR & RESET_BY_IWDG) != 0u;
    RCC_CSR |= RESET_FLAGS_CLEAR;
    if (!clock_start())
        clock_failed = true;
    pins_start();
    IWDG_KR = IWDG_START;
    iwdg_reload(clock_failed ? IWDG_LONG : IWDG_SHORT);
    DAC_CR = 1u;
    RNG_CR = RNG_ON;
    /* 16 bits, master, most significant first, data taken on the rising edge, 84 MHz / 8. */
    SPI_CR2 = 0u;
    SPI_CR1 = 1u << 11 | 1u << 9 | 1u << 8 | 2u << 3 | 1u << 2;
    SPI_CR1 |= 1u << 6;
    TIM_ARR(TIM2) = 0xffffffffu;
    TIM_CCMR1(TIM2) = 0x01u; /* channel 1 takes the time of a rising edge */
    TIM_CCER(TIM2) = 1u;
    TIM_EGR(TIM2) = 1u;
    TIM_CR1(TIM2) = 1u;
    last_count = TIM_CNT(TIM2);
    PWR_CR = PWR_SCALE_1 | PVD_2V8;
    EXTI_RTSR = EXTI_PVD; /* rising: the supply falls */
    evlcp_init(&board);
    if (by_watchdog)
        evlcp_hardware_failed(&board);
    EXTI_PR = EXTI_PVD;
    EXTI_IMR = EXTI_PVD;
    /* SysTick and PVD are the highest, to get through a chip interrupt that hangs. A byte waits for 10 us, a row
       for a whole chip: the receive interrupt, which takes less than a microsecond, goes before. */
    irq_enable(IRQ_PVD, 0x00u);
    irq_enable(IRQ_USART1, 0x10u);
    irq_enable(IRQ_DMA2_STREAM5, 0x20u);
    USART_BRR = (clock_failed ? HSI_HZ : CORE_HZ / 2u) / EVLCP_BAUD;
    USART_CR1 = 1u << 13 | 1u << 5 | 1u << 3 | 1u << 2; /* on, receive interrupt, transmitter, receiver */
    for (;;) {
        evlcp_poll(&board);
        check_chip_progress();
        if (failed) {
            failed = false;
            evlcp_hardware_failed(&board);
        }
        IWDG_KR = IWDG_FEED;
    }
}

/* The linker script's entry, the first instruction after reset: copy initialised data, clear the rest, go. */
void reset_handler(void)
{
    const uint32_t *from = link_data_load;
    /* The linker script makes each pair of symbols the ends of one region. */
    // cppcheck-suppress comparePointers
    for (uint32_t *to = link_data_start; to < link_data_end; to++)
        *to = *from++;
    // cppcheck-suppress comparePointers
    for (uint32_t *to = link_bss_start; to < link_bss_end; to++)
        *to = 0u;
    (void)main();
    fault_handler();
}

union vector {
    uint32_t *stack;
    void (*handler)(void);
};

__attribute__((section(".vectors"), used)) static const union vector vectors[16 + 82] = {
    [0] = {.stack = link_stack},
    [1] = {.handler = reset_handler},
    [2] = {.handler = clock_handler},
    [3 ... 14] = {.handler = fault_handler},
    [15] = {.handler = silence_handler},
    [16 + IRQ_PVD] = {.handler = supply_handler},
    [16 + IRQ_USART1] = {.handler = receive_handler},
    [16 + IRQ_DMA2_STREAM5] = {.handler = chip_handler},
};
