/* threads.c - what the thread sanitizer can look at: threads that share memory at the same address.
 *
 *   threads protocol COUNT   a writer, a clock and two readers run the protocol on two rings for COUNT writes
 *   threads clock NAME       clock threads tick a real-time store while its process reads, writes and polls its edges
 *
 * Exit status 0: no value was torn, no cut showed an effect without its cause. 1: one was. Others: it could not be tried.
 */
#define _GNU_SOURCE
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

#include "fw_layout.h"

#define SLOTS 8u
#define CYCLES 50u /* at least */
#define WORDS 64u /* more than FW_WORDWISE_MAX bytes, where that is not set otherwise */

typedef struct { fw_slot head; uint64_t words[WORDS]; } slot;
typedef struct { fw_ring ring; slot slots[SLOTS]; fw_cuts cuts; fw_cut log[SLOTS]; } object;
static object cause, effect;
static fw_edge edge;
static _Atomic int done, torn;
static uint64_t count;

static int write_one(object *o) {
    uint64_t w = FW_LOAD(o->ring.head, relaxed) + 1, words[WORDS];
    if (!fw_may_write(&o->ring, &o->cuts, &edge, w, SLOTS)) return 0;
    for (uint32_t i = 0; i < WORDS; i++) words[i] = w;
    fw_slot_open(&o->slots[w % SLOTS].head, w);
    fw_copy_in(o->slots[w % SLOTS].words, words, sizeof words);
    fw_slot_publish(&o->ring, &o->slots[w % SLOTS].head, &edge, w);
    return 1;
}

static void *write_all(void *unused) {
    for (uint64_t k = 1; k <= count || FW_LOAD(edge.cycle, relaxed) < CYCLES; k++) {
        while (!write_one(&cause)) sched_yield();
        while (!write_one(&effect)) sched_yield();
    }
    done = 1;
    return unused;
}

static void *tick_all(void *unused) {
    for (uint64_t c = 1; !done; c++) {
        fw_tick_begin(&edge, c);
        fw_tick_object(&cause.ring, &cause.cuts, SLOTS, c);
        fw_tick_object(&effect.ring, &effect.cuts, SLOTS, c);
        fw_tick_end(&edge, c);
        sched_yield();
    }
    return unused;
}

/* The value of a write: its number, 0 when it has gone. */
static uint64_t read_one(object *o, uint64_t w) {
    uint64_t words[WORDS];
    slot *s = &o->slots[w % SLOTS];
    if (w == 0 || fw_slot_check(&s->head, w) < 0) return 0;
    fw_copy_out(words, s->words, sizeof words);
    if (fw_slot_still(&s->head, w) < 0) return 0;
    for (uint32_t i = 0; i < WORDS; i++) torn += words[i] != w;
    return w;
}

static void *read_all(void *unused) {
    while (!done) {
        uint64_t c = FW_LOAD(edge.cycle, acquire);
        int64_t e = fw_cut_find(&effect.cuts, SLOTS, c), k = fw_cut_find(&cause.cuts, SLOTS, c);
        if (e > k && k >= 0) torn++;
        read_one(&effect, e > 0 ? (uint64_t)e : 0);
        read_one(&cause, FW_LOAD(cause.ring.head, acquire));
    }
    return unused;
}

static int protocol(void) {
    pthread_t threads[4];
    void *(*const parts[4])(void *) = {write_all, tick_all, read_all, read_all};
    for (int i = 0; i < 4; i++)
        if (pthread_create(&threads[i], NULL, parts[i], NULL) != 0) return 2;
    for (int i = 0; i < 4; i++) pthread_join(threads[i], NULL);
    printf("cycles %lu torn %d\n", (unsigned long)FW_LOAD(edge.cycle, relaxed), torn);
    return torn != 0;
}

static int run_clock(const char *name) {
    fw_db *db;
    fw_clock_thread *first, *standby;
    fw_edges *edges;
    uint8_t heard[64];
    fw_opts opts = {.clock = FW_REAL, .tick_ns = 1000000};
    const char *const wait_for[] = {"worker"};
    int r = fw_create(&db, name, &opts);
    if (r == 0) r = fw_clock_start(&first, name, wait_for, 1);
    if (r == 0) r = fw_clock_start(&standby, name, wait_for, 1);
    if (r == 0) r = fw_edges_start(&edges, name, 0);
    if (r < 0) { fprintf(stderr, "start: %d\n", r); return 2; }
    int component = fw_join(db, "worker", NULL);
    fw_spec spec = {.name = "worker/count", .size = 512, .n_slots = 16, .every = 1, .component = (uint32_t)component};
    fw_handle h = fw_insert(db, &spec);
    uint64_t words[WORDS] = {0}, back[WORDS];
    fw_info info;
    for (uint64_t k = 1; k <= 50; k++) {
        int64_t c = fw_step(db, (uint32_t)component, 1000000000);
        words[0] = words[WORDS - 1] = k;
        int64_t w = fw_write(db, h, words, sizeof words, (int64_t)k, NULL, 0);
        if (c < 0 || w < 0 || fw_read(db, h, (uint64_t)w, back, sizeof back, &info) < 0) r = 1;
        if (back[0] != k || back[WORDS - 1] != k) r = 1;
        fw_done(db, (uint32_t)component, (uint64_t)c);
        struct pollfd cycles = {.fd = fw_edges_fd(edges), .events = POLLIN};
        if (poll(&cycles, 1, 1000) != 1 || read(cycles.fd, heard, sizeof heard) < 1) r = 1;
        if (k == 25 && fw_clock_stop(first) < 0) r = 1; /* the standby goes on */
    }
    fw_edges_stop(edges);
    if (fw_clock_stop(standby) < 0) r = 1;
    printf("cycles %lu torn %d\n", (unsigned long)fw_cycle(db), r);
    fw_close(db);
    return r;
}

int main(int argc, char **argv) {
    if (argc == 3 && strcmp(argv[1], "clock") == 0) return run_clock(argv[2]);
    if (argc != 3 || strcmp(argv[1], "protocol") != 0) {
        fprintf(stderr, "usage: threads protocol COUNT | clock NAME\n");
        return 2;
    }
    count = strtoull(argv[2], NULL, 10);
    return protocol();
}
