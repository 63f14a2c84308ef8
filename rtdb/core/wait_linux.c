/* wait_linux.c - the only file that knows how this platform waits. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/futex.h>
#include <limits.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include "fw_layout.h"

static int64_t ns_of(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

int64_t fw_platform_monotonic_ns(void) { return ns_of(CLOCK_MONOTONIC); }
int64_t fw_platform_unix_ns(void) { return ns_of(CLOCK_REALTIME); }

int fw_platform_wait(fw_u32 *word, uint32_t seen, int64_t timeout_ns) {
    if (timeout_ns <= 0) return -ETIMEDOUT;
    struct timespec t = {timeout_ns / 1000000000, timeout_ns % 1000000000};
    return syscall(SYS_futex, word, FUTEX_WAIT, seen, &t, NULL, 0) == 0 ? 0 : -errno;
}

void fw_platform_wake(fw_u32 *word) { syscall(SYS_futex, word, FUTEX_WAKE, INT_MAX, NULL, NULL, 0); }

void fw_platform_sleep_until(int64_t t_ns) {
    struct timespec t = {t_ns / 1000000000, t_ns % 1000000000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
}
