/* A firmware for its symbols only: what apps call is at fixed places of it. */
typedef unsigned int u32;
volatile u32 ticks;
u32 state_of_firmware[8] = {1};
int r2p_publish(int topic, const void *message, u32 length) { return topic + (int)length + (message != 0); }
void r2p_sleep(u32 ms) { ticks += ms; }
void reset(void) { for (;;) r2p_sleep(r2p_publish(1, 0, 1)); }
__attribute__((section(".near"))) void r2p_near(void) { ticks++; }
