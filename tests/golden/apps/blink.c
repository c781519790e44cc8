/* An app of a firmware module, with what needs each kind of relocation: see README.md. */
typedef unsigned int u32;

extern int r2p_publish(int topic, const void *message, u32 length);
extern void r2p_sleep(u32 ms);
extern volatile u32 ticks;
extern void hook(void) __attribute__((weak));

struct config { u32 period_ms; int gain; char text[16]; };
const struct config app_config __attribute__((section(".config"), used)) = {500, -3, "blink"};

static int state = 7;
static int *pointer = &state;
static u32 count;
static int history[16];
u32 shared;  /* -fcommon */

static const char *const names[] = {"red", "green", "blue"};
static int square(int x) { return x * x; }
static int twice(int x) { return x + x; }
int (*const functions[])(int) = {square, twice};

__attribute__((constructor(101))) static void first(void) { history[0] = 1; }
__attribute__((constructor)) static void second(void) { history[1] = 2; }
__attribute__((destructor)) static void last(void) { history[2] = 3; }

__attribute__((noinline)) static int step(u32 n)
{
    switch (n % 6) {
    case 0: return functions[0](*pointer);
    case 1: return functions[1](state);
    case 2: return names[count % 3][0];
    case 3: return (int)ticks;
    case 4: return history[n & 15];
    default: return app_config.gain;
    }
}

int finish(int value) { return r2p_publish(1, &value, sizeof value); }

__attribute__((noreturn)) void app_main(void)
{
    for (;;) {
        history[count & 15] = step(count);
        shared += finish(history[count & 15]);
        count++;
        if (hook) hook();
        r2p_sleep(app_config.period_ms);
    }
}
