/* protocol_steps.c - one thread plays all parts: at each load, store and fence of one part, another part cuts in and
 * runs to its end, or the part ends there for good. What a single interruption can break is found every time; memory order is not looked at.
 *
 * Exit status 0: nothing broke. 1: a line says what.
 */
#define FW_ATOMICS
#include <setjmp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

typedef uint64_t fw_u64;
typedef uint32_t fw_u32;
static void step(void);
#define FW_LOAD(a, order) (step(), (a))
#define FW_STORE(a, v, order) (step(), (void)((a) = (v)))
#define FW_FENCE(order) step()
#define FW_FETCH_ADD(a, v) (step(), (a) += (v), (a) - (v))
#define FW_EXCHANGE_IF(a, seen, v) (step(), (a) == (seen) ? ((a) = (v), 1) : ((seen) = (a), 0))
#define FW_WAKE(word) ((void)(word))
#include "protocol.h"

#define N 5u /* slots */

typedef struct { fw_slot head; fw_u64 payload; } slot;
static struct { fw_ring ring; slot slots[N]; union { fw_cuts cuts; uint64_t room[4 + 2 * N]; } u; } a, b, *const both[2] = {&a, &b}; /* cause, effect */
static fw_edge clock_;
static uint64_t shown[2][1000]; /* what each cut showed when it was new */
static int countdown, extent, cut_in;
static void (*intruder)(void);
static const char *part;
static unsigned seed;

static void step(void) {
    if (countdown == 0 || --countdown > 0) return;
    cut_in = 1;
    intruder();
}

static void broken(const char *what, uint64_t c, int64_t x, int64_t y) {
    printf("%s: %s in cycle %lu: %ld %ld (seed %u extent %d)\n", part, what, (unsigned long)c, (long)x, (long)y, seed, extent);
    exit(1);
}

static int write_one(int i) {
    uint64_t w = both[i]->ring.head + 1;
    if (!fw_may_write(&both[i]->ring, &both[i]->u.cuts, &clock_, w, N)) return 0;
    slot *s = &both[i]->slots[w % N];
    fw_slot_open(&s->head, w);
    fw_copy_in(&s->payload, &w, 8);
    fw_slot_publish(&both[i]->ring, &s->head, &clock_, w);
    return 1;
}

/* The cause in a, then its effect of the same number in b. */
static int write_pair(void) {
    if (a.ring.head == b.ring.head && !write_one(0)) return 0;
    return write_one(1);
}

static int64_t value_at(int i, uint64_t c) {
    int64_t w = fw_cut_find(&both[i]->u.cuts, N, c), r;
    uint64_t value;
    if (w <= 0) return w;
    slot *s = &both[i]->slots[(uint64_t)w % N];
    if ((r = fw_slot_check(&s->head, (uint64_t)w)) < 0) return r;
    fw_copy_out(&value, &s->payload, 8);
    return (r = fw_slot_still(&s->head, (uint64_t)w)) < 0 ? r : (int64_t)value;
}

static void tick(void) {
    uint64_t c = clock_.cycle + 1;
    fw_tick_begin(&clock_, c);
    for (int i = 0; i < 2; i++) fw_tick_object(&both[i]->ring, &both[i]->u.cuts, N, c);
    fw_tick_end(&clock_, c);
    for (int i = 0; i < 2; i++) shown[i][c] = both[i]->u.cuts.now;
}

static void write_pairs(void) { for (int k = 0; k < extent && write_pair(); k++) ; }
static void tick_and_write(void) { for (int k = 0; k < extent; k++) { tick(); write_pair(); } }
static void ticks(void) { for (int k = 0; k < extent; k++) tick(); }

static void look(void) {
    for (uint64_t c = 0; c <= clock_.cycle; c++)
        for (int i = 0; i < 2; i++) {
            int64_t value = value_at(i, c);
            if (value != -ESTALE && value != (int64_t)shown[i][c]) broken("another value", c, value, (int64_t)shown[i][c]);
        }
}

static void check(void) {
    uint64_t c = clock_.cycle;
    look();
    for (uint64_t k = c; k + 2 > c && k > 0; k--) { /* the two newest cuts */
        int64_t cause = value_at(0, k), effect = value_at(1, k);
        if (cause < 0 || effect < 0) broken("a value of the newest cuts is gone", k, cause, effect);
        if (effect > cause) broken("an effect without its cause", k, cause, effect);
    }
    tick();
    tick();
    if (!write_pair()) broken("the writer is refused for good", clock_.cycle, (int64_t)a.ring.head, (int64_t)b.ring.head);
    look();
}

/* Some history, which depends on the seed alone. */
static void begin(void) {
    memset(&a, 0, sizeof a);
    memset(&b, 0, sizeof b);
    memset(&clock_, 0, sizeof clock_);
    memset(shown, 0, sizeof shown);
    unsigned random = seed * 2654435761u + 1;
    for (unsigned k = 0; k < seed % 13; k++) {
        random = random * 1664525u + 1013904223u;
        if (random >> 30) write_pair(); else tick();
        if (random >> 28 & 1) tick();
    }
}

static void a_search(void) {
    uint64_t c = clock_.cycle * (seed % 7) / 6;
    int i = (int)(seed & 1);
    int64_t value = value_at(i, c);
    if (value != -ESTALE && value != (int64_t)shown[i][c]) broken("another value", c, value, (int64_t)shown[i][c]);
}

/* Lets the intruder cut in at each step of the part, after each of many histories. */
static void play(const char *name, void (*one)(void), void (*other)(void)) {
    part = name;
    for (seed = 0; seed < 2000; seed++)
        for (extent = 1; extent <= (int)N + 3; extent++)
            for (int at = 1, more = 1; more; at++) {
                begin();
                intruder = other;
                cut_in = 0;
                countdown = at;
                one();
                countdown = 0;
                more = cut_in;
                check();
            }
}

/* A process is killed at a step; what it had not done is left, and another takes over. */
static jmp_buf death;
static void die(void) { longjmp(death, 1); }

static void a_clock_and_its_successor(void) {
    if (setjmp(death) == 0) { tick(); return; }
    for (int k = 1; k < extent && write_pair(); k++) ;
    tick();
}

static void a_writer_and_its_successor(void) {
    if (setjmp(death) == 0) { write_pair(); return; }
    ticks();
    write_pair();
}

static void a_pair(void) { write_pair(); }

int main(void) {
    play("a tick, cut in by a writer", tick, write_pairs);
    play("a tick, cut in by a reader", tick, look);
    play("a writer, cut in by ticks", a_pair, ticks);
    play("a writer, cut in by a reader", a_pair, look);
    play("a search, cut in by ticks and writes", a_search, tick_and_write);
    play("a clock that dies", a_clock_and_its_successor, die);
    play("a writer that dies", a_writer_and_its_successor, die);
    puts("whole");
    return 0;
}
