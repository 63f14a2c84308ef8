/* protocol_relacy.cpp - protocol.h, compiled as it stands, under Relacy: a model checker that runs the threads of a small
 * scenario in random orders, and lets loads return older values wherever C11 allows it, whatever this machine does.
 *
 *     protocol_relacy MODEL EXECUTIONS
 *
 * Execution i of a model is the same on every machine. Exit status 0: "whole", nothing broke in that many. 1: Relacy's
 * report of the first execution that broke. This is a search, not a proof; that it finds mistakes is shown by mutants of
 * protocol.h in test_protocol_model.py. It does not play loads that see the future, nor values more than two stores older
 * than the newest. Its seq_cst fences are cumulative, as in C++20 and in hardware: what a writer read before its fence
 * counts like what it wrote. The text of C11 promises that for the writer's own stores only; two writers in `cut` need it.
 *
 *   model   threads                                   what must not happen
 *   ring    writer that laps, 2 readers               a read that is called whole is not exactly write w
 *   cut     1 or 2 writers, clock                     a cut shows an effect without its cause
 *   ticks   writer, clock, reader                     a cut changes its mind; one of the two newest cuts cannot be read
 *   wait    2 waiters, 2 notifiers, which may die     somebody sleeps although what he waits for is the case
 *   life    deleter, 2 readers                        bytes of the next object are taken for those of this one
 *
 * -DMODEL=ring compiles that model alone, which is quicker.
 */
#include <relacy/relacy.hpp>

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <sstream>

/* -- what protocol.h is compiled with ---------------------------------------------------------------------------- */

#define FW_ATOMICS
template <class T> struct Word : rl::atomic<T> {
    Word() : rl::atomic<T>(0) {} /* shared memory begins as zeros */
};
typedef Word<uint64_t> fw_u64;
typedef Word<uint32_t> fw_u32;
static void wake(fw_u32 *word);
#define FW_LOAD(a, order) (a)($).load(rl::mo_##order)
#define FW_STORE(a, v, order) (a)($).store((v), rl::mo_##order)
#define FW_FENCE(order) rl::atomic_thread_fence(rl::mo_##order, $)
#define FW_FETCH_ADD(a, v) (a)($).fetch_add((v), rl::mo_seq_cst)
#define FW_EXCHANGE_IF(a, seen, v) (a)($).compare_exchange_strong((seen), (v), rl::mo_seq_cst, rl::mo_relaxed)
#define FW_WAKE(word) wake(word)
#include "protocol.h"

/* -- the kernel's side of waiting ------------------------------------------------------------------------------- */

struct Killed {};

/* The kernel compares the word and puts the caller to sleep under one lock, and wakes under the same. */
static struct Futex {
    rl::mutex lock;
    rl::condition_variable sleepers;
    unsigned dies[4]; /* by thread: 1, it is killed before its call wakes anybody; 2, after that; 0, it lives */
} *futex;

static void sleep_while(fw_u32 *word, uint32_t seen) {
    futex->lock.lock($);
    if (FW_LOAD(*word, relaxed) == seen) futex->sleepers.wait(futex->lock, $); /* may end for no reason, like futex(2) */
    futex->lock.unlock($);
}

static void wake(fw_u32 *) {
    unsigned dies = futex->dies[rl::thread_index()];
    if (dies == 1) throw Killed();
    futex->lock.lock($);
    futex->sleepers.notify_all($);
    futex->lock.unlock($);
    if (dies == 2) throw Killed();
}

/* -- an object, written, read and ticked in the order of objects.c ---------------------------------------------- */

enum { SLOTS = 4, ENTRIES = 3, MOST = 40 };

struct Payload { /* two words, so that half a write is seen */
    uint64_t write, cause;
};

struct Object {
    fw_ring ring;
    struct { fw_slot head; fw_u64 words[2]; } slots[SLOTS];
    struct { fw_cuts cuts; fw_cut entries[ENTRIES]; } log;
    uint64_t written, causes[MOST]; /* what was written; not shared memory: only assertions look here */
    int64_t shown[MOST];            /* what each cut showed when it was new */

    Object() : written(), causes(), shown() { RL_ASSERT(fw_log(&log.cuts) == log.entries); }

    /* False when the protocol holds the writer back. */
    bool write(fw_edge &clock, uint64_t cause, bool may_lap = false) {
        uint64_t w = FW_LOAD(ring.head, relaxed) + 1;
        RL_ASSERT(w == written + 1); /* base = w - 1 means the write before only if numbers are consecutive */
        if (!may_lap && !fw_may_write(&ring, &log.cuts, &clock, w, SLOTS)) return false;
        written = w;
        causes[w] = cause;
        Payload payload = {w, cause};
        fw_slot_open(&slots[w % SLOTS].head, w);
        fw_copy_in(slots[w % SLOTS].words, &payload, sizeof payload);
        fw_slot_publish(&ring, &slots[w % SLOTS].head, &clock, w);
        return true;
    }

    /* 0 when the payload is called whole. */
    int read(uint64_t w, Payload *payload) {
        int r = fw_slot_check(&slots[w % SLOTS].head, w);
        if (r < 0) return r;
        fw_copy_out(payload, slots[w % SLOTS].words, sizeof *payload);
        return fw_slot_still(&slots[w % SLOTS].head, w);
    }

    void must_be(uint64_t w, const Payload &payload) { RL_ASSERT(payload.write == w && payload.cause == causes[w]); }

    int read_whole(uint64_t w) {
        Payload payload;
        int r = read(w, &payload);
        if (r == 0) must_be(w, payload);
        return r;
    }

    int64_t find(uint64_t c) { return fw_cut_find(&log.cuts, ENTRIES, c); }

    void tick(uint64_t c) {
        fw_tick_object(&ring, &log.cuts, ENTRIES, c);
        shown[c] = find(c);
        RL_ASSERT(shown[c] >= 0 && shown[c] >= shown[c - 1]);
    }
};

/* -- the models -------------------------------------------------------------------------------------------------- */

namespace model {

/* No cut holds the writer back: it overtakes the readers. */
struct ring : rl::test_suite<ring, 3> {
    Object object;
    fw_edge clock;

    void before() {
        while (object.written < SLOTS) object.write(clock, 100 + object.written, true);
    }

    void thread(unsigned who) {
        if (who == 0) writer();
        if (who == 1) by_head();
        if (who == 2) by_number();
    }

    void writer() {
        while (object.written < 2 * SLOTS + 1) object.write(clock, 100 + object.written, true);
    }

    /* Takes the newest, or one that is about to be overwritten. */
    void by_head() {
        for (int i = 0; i < 3; i++) {
            uint64_t head = FW_LOAD(object.ring.head, acquire);
            RL_ASSERT(object.read_whole(head - rl::rand(SLOTS)) != -EAGAIN); /* head says that it was written */
        }
    }

    /* Follows write by write and never looks at head: seq alone tells it that a write is there. */
    void by_number() {
        uint64_t w = SLOTS + 1;
        for (int i = 0; i < 4; i++)
            if (object.read_whole(w) != -EAGAIN) w++;
    }
};

struct cut : rl::test_suite<cut, 3> {
    Object cause, effect;
    fw_edge clock;
    bool two_writers, effect_first;

    void before() {
        two_writers = rl::rand(2);
        effect_first = rl::rand(2);
    }

    void thread(unsigned who) {
        if (who == 0) first_writer();
        if (who == 1 && two_writers) second_writer();
        if (who == 2)
            for (uint64_t c = 1; c <= 2; c++) tick(c);
    }

    void first_writer() {
        for (int i = 0; i < 3; i++) {
            cause.write(clock, 0);
            if (!two_writers) effect.write(clock, cause.written);
        }
    }

    void second_writer() {
        for (int i = 0; i < 3; i++) {
            uint64_t newest = FW_LOAD(cause.ring.head, acquire);
            if (newest && cause.read_whole(newest) == 0) effect.write(clock, newest);
        }
    }

    void tick(uint64_t c) {
        fw_tick_begin(&clock, c);
        (effect_first ? effect : cause).tick(c);
        (effect_first ? cause : effect).tick(c);
        fw_tick_end(&clock, c);
        RL_ASSERT((int64_t)effect.causes[effect.shown[c]] <= cause.shown[c]);
    }
};

/* The cut log has fewer entries than there are ticks, and the ring fewer slots than there are writes. */
struct ticks : rl::test_suite<ticks, 3> {
    Object object;
    fw_edge clock;
    uint64_t c;

    /* Some history, or none; it may end in the middle of a tick. */
    void before() {
        c = 0;
        for (unsigned n = rl::rand(5); n > 0; n--) {
            write(rl::rand(3));
            begin();
            if (n == 1 && rl::rand(2)) break;
            end();
        }
        write(rl::rand(5));
    }

    void thread(unsigned who) {
        if (who == 0) write(5);
        if (who == 1)
            for (int i = 0; i < 4; i++) {
                if (begun() == clock.cycle.debug_value()) begin();
                end();
            }
        if (who == 2)
            for (int i = 0; i < 3; i++) look();
    }

    void write(unsigned n) {
        while (n-- > 0) object.write(clock, 0); /* or is held back */
    }

    uint64_t begun() { return clock.epoch.debug_value(); } /* looks past the model: the newest tick that began */
    void begin() { fw_tick_begin(&clock, ++c); }

    void end() {
        object.tick(c);
        fw_tick_end(&clock, c);
    }

    void look() {
        uint64_t newest = FW_LOAD(clock.cycle, acquire), back = rl::rand(4);
        if (back > newest) back = newest;
        int64_t w = object.find(newest - back);
        if (w == -ESTALE) RL_ASSERT(back > 1 || begun() >= newest + 2); /* the log holds the two newest cuts, and more */
        else RL_ASSERT(w == object.shown[newest - back]);
        if (w <= 0) return;
        int r = object.read_whole((uint64_t)w);
        RL_ASSERT(r != -EAGAIN);
        if (r == -ESTALE) RL_ASSERT(begun() >= newest + 2 - back); /* not while one of the two newest cuts shows it */
    }
};

/* The condition of each waiter is made true by one notifier, and both notify through the same word. */
struct wait : rl::test_suite<wait, 4> {
    enum { ROUNDS = 3 };
    fw_u32 word;
    fw_u64 a, b;
    Futex kernel;

    void before() { futex = &kernel; }

    void thread(unsigned who) {
        if (who == 0)
            for (uint64_t round = 1; round <= ROUNDS; round++) until(a, round);
        if (who == 1) {
            until(b, 1);
            if (rl::rand(4)) until(a, ROUNDS);
            else fw_announce(&word); /* and is killed before it sleeps */
        }
        if (who == 2)
            for (uint64_t round = 1; round <= ROUNDS; round++) make(a, round, round < ROUNDS);
        if (who == 3) make(b, 1, false);
    }

    void until(fw_u64 &condition, uint64_t value) {
        for (;;) {
            if (FW_LOAD(condition, relaxed) >= value) return;
            uint32_t seen = fw_announce(&word);
            if (FW_LOAD(condition, relaxed) >= value) return;
            sleep_while(&word, seen);
        }
    }

    void make(fw_u64 &condition, uint64_t value, bool may_die) {
        FW_STORE(condition, value, relaxed);
        try {
            kernel.dies[rl::thread_index()] = may_die ? rl::rand(3) : 0;
            fw_notify(&word);
        } catch (Killed) {
        }
    }
};

/* The object is deleted and its storage becomes another's, whose writes have the same numbers in the same slots. Only the
 * life number tells them apart. */
struct life : rl::test_suite<life, 3> {
    Object object;
    fw_edge clock;
    fw_u64 number;

    void before() {
        FW_STORE(number, 1, relaxed);
        for (uint64_t c = 1; c <= SLOTS; c++) {
            object.write(clock, 100 + c);
            fw_tick_begin(&clock, c);
            object.tick(c);
            fw_tick_end(&clock, c);
        }
    }

    void thread(unsigned who) {
        if (who == 0) reuse();
        else if (rl::rand(2)) read();
        else look_up();
    }

    void reuse() {
        fw_life_end(&number, 2);
        for (uint64_t w = 1; w <= SLOTS; w++) {
            for (fw_u64 &word : object.slots[w % SLOTS].words) FW_STORE(word, 7, relaxed);
            FW_STORE(object.slots[w % SLOTS].head.seq, 2 * w, relaxed);
        }
        for (fw_cut &entry : object.log.entries) {
            FW_STORE(entry.cycle, 0, relaxed);
            FW_STORE(entry.write, 7, relaxed);
        }
        FW_STORE(number, 3, release);
    }

    void read() {
        uint64_t w = 1 + rl::rand(SLOTS);
        Payload payload;
        if (object.read(w, &payload) == 0 && fw_life_still(&number, 1) == 0) object.must_be(w, payload);
    }

    void look_up() {
        uint64_t c = 1 + rl::rand(SLOTS);
        int64_t w = object.find(c);
        if (w != -ESTALE && fw_life_still(&number, 1) == 0) RL_ASSERT(w == object.shown[c]);
    }
};

} // namespace model

/* -- running them ------------------------------------------------------------------------------------------------- */

template <class Model> static bool whole(unsigned long executions) {
    typedef rl::random_scheduler<Model::params::thread_count> random;
    std::ostringstream silence;
    rl::ostringstream broken;
    rl::test_params params;
    params.iteration_count = executions;
    params.progress_stream = &silence;
    if (rl::run_test<Model, random>(params, broken, false) == rl::test_result_success) return true;
    params.initial_state = broken.str(); /* that execution once more, with its report */
    params.collect_history = true;
    rl::run_test<Model, random>(params, broken, true);
    return false;
}

static const struct { const char *name; bool (*whole)(unsigned long executions); } models[] = {
#ifdef MODEL
#define TEXT_OF(name) #name
#define NAME_OF(name) TEXT_OF(name)
    {NAME_OF(MODEL), whole<model::MODEL>},
#else
    {"ring", whole<model::ring>},
    {"cut", whole<model::cut>},
    {"ticks", whole<model::ticks>},
    {"wait", whole<model::wait>},
    {"life", whole<model::life>},
#endif
};

int main(int argc, char **argv) {
    for (auto &one : models)
        if (argc == 3 && !strcmp(argv[1], one.name)) {
            if (!one.whole(strtoul(argv[2], nullptr, 10))) return 1;
            std::cout << "whole" << std::endl;
            return 0;
        }
    std::cerr << "usage: protocol_relacy MODEL EXECUTIONS; models:";
    for (auto &one : models) std::cerr << ' ' << one.name;
    std::cerr << std::endl;
    return 2;
}
