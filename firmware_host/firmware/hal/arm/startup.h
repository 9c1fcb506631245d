/* Entry points of the vector table, and the few core registers the HALs use. */
#ifndef EVLCP_STARTUP_H
#define EVLCP_STARTUP_H

#include <stdint.h>

/* First instruction after reset. */
void reset_handler(void);

/* Every exception that should not happen. */
void fault_handler(void);

/* Dark by the shortest way; nothing else works any more. */
void hal_panic(void);

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define NVIC_ISER(n) REGISTER(0xe000e100u + 4u * (n))
#define NVIC_ICPR(n) REGISTER(0xe000e280u + 4u * (n))
#define NVIC_PRIORITY(irq) (*(volatile uint8_t *)(0xe000e400u + (irq)))

static inline void irq_enable(uint32_t irq, uint8_t priority)
{
    NVIC_PRIORITY(irq) = priority;
    NVIC_ISER(irq / 32u) = 1u << irq % 32u;
}

static inline void irq_forget(uint32_t irq)
{
    NVIC_ICPR(irq / 32u) = 1u << irq % 32u;
    __asm volatile("dsb\n isb" ::: "memory");
}

#endif
