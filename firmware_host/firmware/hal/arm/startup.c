/* Reset: copy initialised data, clear the rest, go. A fault leaves the LEDs dark: hal_panic. */
#include "startup.h"

extern uint32_t link_data_load[];
extern uint32_t link_data_start[];
extern uint32_t link_data_end[];
extern uint32_t link_bss_start[];
extern uint32_t link_bss_end[];

int main(void);

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

void fault_handler(void)
{
    hal_panic();
    for (;;) {
    }
}
