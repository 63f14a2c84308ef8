/* rtdb_core.c - how long the store's C interface takes. Compiled and run by rtdb.py.
 *
 *   rtdb_core speed NAME     one line per quantity: name, minimum ns, median ns
 *   rtdb_core table NAME N   one line per operation: name, average, minimum, maximum us of N single calls
 *   rtdb_core ping NAME N    N times in ns from a write to the awakened reader in another process, and the same of a bare futex
 *   rtdb_core pong NAME N    round trips a second of two processes that wake each other by a bare futex, N windows of 0.25 s
 *   rtdb_core churn NAME N   inserts and deletes N times with 900 objects alive, for a profiler
 *
 * Short operations are timed in batches, so that the clock's own 25 ns do not count; those of `table` are timed one by
 * one. What is compared with each other is timed in turn, batch by batch. Two processes are held on the first and the last core
 * that is allowed: a wake-up on the waker's own core takes a fifth of the time, and where the system puts them is chance.
 */
#define _GNU_SOURCE
#include <linux/futex.h>
#include <sched.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "fw_rtdb.h"

#define ROUNDS 400
#define FRAME (300u * 1024u)

static int64_t now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static cpu_set_t allowed;

static void hold_on_core(int last) { /* the first or the last of those where we may run */
    cpu_set_t one;
    int core = last ? CPU_SETSIZE - 1 : 0;
    while (!CPU_ISSET(core, &allowed)) core += last ? -1 : 1;
    CPU_ZERO(&one);
    CPU_SET(core, &one);
    sched_setaffinity(0, sizeof one, &one);
}

static void pause_ns(long ns) {
    struct timespec t = {0, ns};
    nanosleep(&t, NULL);
}

static int order(const void *a, const void *b) { return (*(const double *)a > *(const double *)b) - (*(const double *)a < *(const double *)b); }

static void report(const char *name, double *samples, int n) {
    qsort(samples, (size_t)n, sizeof *samples, order);
    printf("%s %.1f %.1f\n", name, samples[0], samples[n / 2]);
    fflush(stdout);
}

static void die(const char *what, int64_t r) {
    fprintf(stderr, "%s: %s\n", what, strerror((int)-r));
    exit(2);
}

static fw_handle insert(fw_db *db, int component, const char *name, uint32_t size, uint32_t n_slots) {
    fw_spec spec = {.size = size, .n_slots = n_slots, .every = 1, .component = (uint32_t)component, .flags = FW_IMMEDIATE_DELETE};
    snprintf(spec.name, sizeof spec.name, "%s", name);
    fw_handle h = fw_insert(db, &spec);
    if (h < 0) die("insert", h);
    return h;
}

static fw_db *make_kind(const char *name, uint32_t clock, int *component) {
    fw_db *db;
    fw_opts opts = {.size = 16u << 20, .max_objects = 1024, .clock = clock};
    int r = fw_create(&db, name, &opts);
    if (r < 0) die("create", r);
    if ((*component = fw_join(db, "bench", NULL)) < 0) die("join", *component);
    return db;
}

static fw_db *make(const char *name, int *component) { return make_kind(name, FW_STEPPED, component); }

static void fill(fw_db *db, int component, int from, int to, fw_handle *handles) {
    for (int i = from; i < to; i++) {
        char name[32];
        snprintf(name, sizeof name, "bench/filler%d", i);
        handles[i] = insert(db, component, name, 64, 8);
    }
}

static double first[ROUNDS], second[ROUNDS], third[ROUNDS];

/* One sample: the mean time of a batch of calls. */
#define TIME(samples, batch, ...) \
    do { \
        int64_t begun = now(); \
        for (int k = 0; k < (batch); k++) { __VA_ARGS__; } \
        (samples)[round] = (double)(now() - begun) / (batch); \
    } while (0)
#define EACH_ROUND for (int round = 0; round < ROUNDS; round++)

static void write_64(fw_db *db, fw_handle h, uint64_t value) {
    uint64_t data[8] = {value};
    if (fw_write(db, h, data, 64, fw_now_ns(db), NULL, 0) < 0) die("write", -1);
}

static void read_64(fw_db *db, fw_handle h, int64_t w) {
    uint64_t out[8];
    fw_info info;
    if (w < 0 || fw_read(db, h, (uint64_t)w, out, sizeof out, &info) < 0) die("read", w);
}

static void ticks(fw_db *db) { /* makes the ring's slots free again */
    for (int i = 0; i < 3; i++) fw_tick(db);
}

/* The same operations in a store with 10 objects and in one with 900, in turn; and a write that reads the clock. */
static void writes_and_reads(const char *name, fw_db *many, fw_handle last) {
    static fw_handle handles[16];
    char other[64];
    int component;
    volatile int64_t sink = 0;
    snprintf(other, sizeof other, "%s-few", name);
    fw_db *few = make(other, &component);
    fill(few, component, 0, 9, handles);
    fw_handle h = insert(few, component, "bench/small", 64, 4096);
    snprintf(other, sizeof other, "%s-real", name);
    fw_db *real = make_kind(other, FW_REAL, &component);
    fw_handle timed = insert(real, component, "bench/small", 64, 4096);
    EACH_ROUND {
        ticks(few);
        ticks(many);
        TIME(first, 1000, write_64(few, h, (uint64_t)k));
        TIME(second, 1000, write_64(many, last, (uint64_t)k));
        TIME(third, 1000, write_64(real, timed, (uint64_t)k));
    }
    report("write_64_at_10", first, ROUNDS);
    report("write_64_at_900", second, ROUNDS);
    report("write_64_real", third, ROUNDS);
    EACH_ROUND {
        TIME(first, 1000, read_64(few, h, fw_newest(few, h)));
        TIME(second, 1000, read_64(many, last, fw_newest(many, last)));
        TIME(third, 1000, sink += now());
    }
    report("read_64_at_10", first, ROUNDS);
    report("read_64_at_900", second, ROUNDS);
    report("clock_read", third, ROUNDS);
    fw_close(few);
    fw_close(real);
}

static void as_of(fw_db *db, int component) {
    fw_handle deep = insert(db, component, "bench/deep", 64, 10100);
    for (int i = 0; i < 10000; i++) {
        write_64(db, deep, (uint64_t)i);
        fw_tick(db);
    }
    int64_t t = fw_now_ns(db), tick_ns = fw_tick_ns(db);
    uint32_t random = 1;
    EACH_ROUND TIME(first, 1000, random = random * 1664525u + 1013904223u;
                    read_64(db, deep, fw_as_of(db, deep, t - (int64_t)((random >> 8) % 9990) * tick_ns)));
    report("as_of_10000", first, ROUNDS);
    fw_delete(db, deep);
}

static void tick(fw_db *db, const fw_handle *handles, int n, const char *name) {
    EACH_ROUND {
        for (int i = 0; i < n; i++) write_64(db, handles[i], (uint64_t)round);
        TIME(first, 1, fw_tick(db));
    }
    report(name, first, ROUNDS);
}

static void inserts(fw_db *db, int component) {
    EACH_ROUND {
        fw_handle h;
        TIME(first, 1, h = insert(db, component, "bench/one-more", 64, 8));
        TIME(second, 1, fw_delete(db, h));
    }
    report("insert_at_900", first, ROUNDS);
    report("delete_at_900", second, ROUNDS);
}

static void frames(fw_db *db, int component) {
    static uint8_t frame[FRAME], out[FRAME], ring[6][FRAME];
    fw_handle big = insert(db, component, "bench/frame", FRAME, 6);
    fw_info info;
    const void *view;
    volatile int64_t sink = 0;
    memset(frame, 1, sizeof frame);
    memset(ring, 1, sizeof ring);
    EACH_ROUND {
        ticks(db);
        TIME(first, 1, if (fw_write(db, big, frame, FRAME, 0, NULL, 0) < 0) die("frame", -1));
        TIME(second, 1, memcpy(ring[round % 6], frame, FRAME); sink += ring[round % 6][round]);
    }
    report("frame_write", first, ROUNDS);
    report("frame_memcpy_to_a_ring", second, ROUNDS);
    EACH_ROUND {
        TIME(first, 1, if (fw_read(db, big, (uint64_t)fw_newest(db, big), out, FRAME, &info) < 0) die("frame", -1));
        TIME(second, 1, memcpy(out, ring[0], FRAME); sink += out[round]);
        TIME(third, 1000, uint64_t w = (uint64_t)fw_newest(db, big);
             if (fw_peek(db, big, w, &view, &info) < 0 || fw_check(db, big, w) < 0) die("view", -1));
    }
    report("frame_read", first, ROUNDS);
    report("frame_memcpy", second, ROUNDS);
    report("frame_view", third, ROUNDS);
    fw_delete(db, big);
}

static void speed(const char *name) {
    static fw_handle handles[1024];
    int component;
    fw_db *db = make(name, &component);
    as_of(db, component);
    fill(db, component, 0, 63, handles); /* 64 with the component's health */
    tick(db, handles, 63, "tick_64");
    fill(db, component, 63, 898, handles);
    fw_handle last = insert(db, component, "bench/last", 64, 4096);
    writes_and_reads(name, db, last);
    inserts(db, component);
    fill(db, component, 898, 998, handles);
    tick(db, handles, 998, "tick_1000");
    frames(db, component);
    fw_close(db);
}

static void churn(const char *name, int n) {
    static fw_handle handles[1024];
    int component;
    fw_db *db = make(name, &component);
    fill(db, component, 0, 899, handles);
    for (int i = 0; i < n; i++) fw_delete(db, insert(db, component, "bench/one-more", 64, 8));
    fw_close(db);
}

static void table_row(const char *name, const int64_t *ns, int n) {
    int64_t sum = 0, least = INT64_MAX, most = 0;
    for (int i = 0; i < n; i++) {
        sum += ns[i];
        if (ns[i] < least) least = ns[i];
        if (ns[i] > most) most = ns[i];
    }
    printf("%s %.3f %.3f %.3f\n", name, (double)sum / n / 1000, (double)least / 1000, (double)most / 1000);
    fflush(stdout);
}

static void pings(fw_db *db, fw_handle h, const char *name, int n, int64_t *ns);

static void table(const char *name, int n) {
    int component;
    fw_db *db = make(name, &component);
    fw_handle h = insert(db, component, "bench/small", 64, 4096);
    int64_t *ns = calloc((size_t)n, sizeof *ns), *deletes = calloc((size_t)n, sizeof *deletes);
    uint64_t data[8] = {0}, out[8];
    fw_info info;
    for (int i = 0; i < n; i++) {
        int64_t begun = now();
        fw_handle one = insert(db, component, "bench/one", 64, 8);
        ns[i] = now() - begun;
        begun = now();
        fw_delete(db, one);
        deletes[i] = now() - begun;
        if (i % 100 == 0) pause_ns(1000000);
    }
    table_row("insert", ns, n);
    table_row("delete", deletes, n);
    for (int i = 0; i < n; i++) {
        if (i % 1000 == 0) { fw_tick(db); fw_tick(db); fw_tick(db); pause_ns(1000000); }
        int64_t begun = now();
        fw_write(db, h, data, 64, 0, NULL, 0);
        ns[i] = now() - begun;
        begun = now();
        fw_read(db, h, (uint64_t)fw_newest(db, h), out, sizeof out, &info);
        deletes[i] = now() - begun;
    }
    table_row("write", ns, n);
    table_row("read", deletes, n);
    pings(db, h, name, n / 5, ns);
    table_row("notify", ns, n / 5);
    fw_close(db);
}

/* -- from a write to the awakened reader in another process ---------------------------------------------------------- */

typedef struct { _Atomic int64_t sent, heard; _Atomic uint32_t word, asleep; _Atomic int stop; } page;

static void pings(fw_db *db, fw_handle h, const char *name, int n, int64_t *ns) {
    page *shared = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    pid_t child = fork();
    if (child == 0) {
        fw_db *mine;
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        hold_on_core(1);
        fw_forget(db);
        if (fw_attach(&mine, name) < 0) _exit(1);
        fw_handle small = fw_find(mine, "bench/small");
        int64_t w = fw_newest(mine, small);
        atomic_store(&shared->asleep, 1);
        while (!shared->stop) {
            w = fw_wait_write(mine, small, (uint64_t)w, INT64_MAX);
            if (w < 0) _exit(1);
            atomic_store(&shared->heard, now());
        }
        _exit(0);
    }
    hold_on_core(0);
    while (!shared->asleep) pause_ns(1000000);
    for (int i = 0; i < n; i++) {
        if (i % 1000 == 0) { fw_tick(db); fw_tick(db); fw_tick(db); }
        pause_ns(200000); /* it sleeps by now */
        uint64_t data[8] = {0};
        atomic_store(&shared->heard, 0);
        int64_t sent = now();
        fw_write(db, h, data, 64, 0, NULL, 0);
        while (!shared->heard) pause_ns(200000);
        ns[i] = shared->heard - sent;
    }
    kill(child, SIGKILL);
    waitpid(child, NULL, 0);
    munmap(shared, 4096);
}

static void bare_pings(int n, int64_t *ns) {
    page *shared = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    pid_t child = fork();
    if (child == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        hold_on_core(1);
        uint32_t seen = 0;
        atomic_store(&shared->asleep, 1);
        for (;;) {
            while (shared->word == seen) syscall(SYS_futex, &shared->word, FUTEX_WAIT, seen, NULL, NULL, 0);
            seen = shared->word;
            atomic_store(&shared->heard, now());
        }
    }
    hold_on_core(0);
    while (!shared->asleep) pause_ns(1000000);
    for (int i = 0; i < n; i++) {
        pause_ns(200000);
        atomic_store(&shared->heard, 0);
        int64_t sent = now();
        atomic_fetch_add(&shared->word, 1);
        syscall(SYS_futex, &shared->word, FUTEX_WAKE, 1, NULL, NULL, 0);
        while (!shared->heard) pause_ns(200000);
        ns[i] = shared->heard - sent;
    }
    kill(child, SIGKILL);
    waitpid(child, NULL, 0);
    munmap(shared, 4096);
}

static void wait_for_turn(_Atomic uint32_t *word, uint32_t mine) {
    uint32_t seen;
    while ((seen = *word) % 2 != mine) syscall(SYS_futex, word, FUTEX_WAIT, seen, NULL, NULL, 0);
}

static void pass_turn(_Atomic uint32_t *word) {
    atomic_fetch_add(word, 1);
    syscall(SYS_futex, word, FUTEX_WAKE, 1, NULL, NULL, 0);
}

static void pong(int n) {
    page *shared = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    pid_t child = fork();
    if (child == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        hold_on_core(1);
        for (;;) { wait_for_turn(&shared->word, 1); pass_turn(&shared->word); }
    }
    hold_on_core(0);
    printf("pong");
    for (int i = 0; i < n; i++) {
        int64_t begun = now(), spent, trips = 0;
        for (; (spent = now() - begun) < 250000000; trips++) { pass_turn(&shared->word); wait_for_turn(&shared->word, 0); }
        printf(" %.1f", (double)trips * 1e9 / (double)spent);
    }
    printf("\n");
    kill(child, SIGKILL);
    waitpid(child, NULL, 0);
}

static void ping(const char *name, int n) {
    int component;
    fw_db *db = make(name, &component);
    fw_handle h = insert(db, component, "bench/small", 64, 4096);
    int64_t *ns = calloc((size_t)n, sizeof *ns);
    for (int kind = 0; kind < 2; kind++) {
        if (kind) bare_pings(n, ns); else pings(db, h, name, n, ns);
        printf(kind ? "futex_ping" : "notify_c");
        for (int i = 0; i < n; i++) printf(" %ld", (long)ns[i]);
        printf("\n");
    }
    fw_close(db);
}

int main(int argc, char **argv) {
    if (argc < 3) { fprintf(stderr, "usage: rtdb_core speed|table|ping|pong|churn NAME [N]\n"); return 2; }
    int n = argc > 3 ? atoi(argv[3]) : 2000;
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    sched_getaffinity(0, sizeof allowed, &allowed);
    if (strcmp(argv[1], "speed") == 0) speed(argv[2]);
    else if (strcmp(argv[1], "table") == 0) table(argv[2], n);
    else if (strcmp(argv[1], "pong") == 0) pong(n);
    else if (strcmp(argv[1], "churn") == 0) churn(argv[2], n);
    else ping(argv[2], n);
    return 0;
}
