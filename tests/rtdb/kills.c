/* kills.c - processes of each role share a store, and one after the other is killed at a random moment.
 *
 *   kills NAME COUNT SEED [PROGRESS]    PROGRESS: say on stderr how far it is, every so many kills
 *
 * The first half of the kills is in a real-time store, the second in a barrier store. Roles: a clock and its standby,
 * writers, readers, waiters, and churners, which insert and delete. After each kill every survivor must go on; what the
 * dead one had is looked at; a successor takes over.
 *
 *   torn    a value whose words do not agree with each other and with its write number, or that another object wrote
 *   lost    an object that must exist and does not, half of a family of objects, a directory that does not add up
 *   frozen  somebody does not go on: the cycle within WATCHDOG_S seconds, a participant of a barrier until the cycle
 *           after the one that was under way has ended, others within MANY_CYCLES cycles
 *   leaked  bytes that are not given back after everything was deleted
 *
 * Exit status 0: none of these was seen. 1: one was, and a line says what. Others: the program could not do its work.
 * The last line has the counts, as words and numbers in turn.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <stdarg.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "consistency.h"

#define TICK_NS 10000000
#define MANY_CYCLES 1000u
#define WATCHDOG_S 60
#define LARGE (256u << 10)
#define WORDS_MAX (LARGE / 8)
#define SETS 2u    /* of objects that are written, each with its writer */
#define FILLERS 400u /* they make ticks longer, so that more kills land in them */
#define FAMILIES 8u /* per churner */
#define OBJECTS 6u  /* of a set */

enum { CLOCK, WRITER, READER, WAITER, CHURNER, ROLES };
static const char *const role_names[ROLES] = {"clock", "writer", "reader", "waiter", "churner"};
/* who there is: role, and how often of 100 it is the one to die */
static const struct { int role; unsigned number, share; } cast[] = {
    {CLOCK, 0, 8}, {CLOCK, 1, 8}, {WRITER, 0, 15}, {WRITER, 1, 15}, {READER, 0, 8}, {READER, 1, 7},
    {WAITER, 0, 6}, {WAITER, 1, 6}, {WAITER, 2, 6}, {CHURNER, 0, 11}, {CHURNER, 1, 10},
};
#define ACTORS (sizeof cast / sizeof cast[0])

/* -- what processes tell the supervisor, in memory that is not the store's ------------------------------------------- */

enum { ELSEWHERE, IN_WRITE, BEGUN, ASLEEP };
enum { ABSENT, INSERTING, PRESENT, DELETING };

typedef struct {
    fw_u64 progress; /* rounds done */
    fw_u32 place;    /* where it is: ELSEWHERE, ... */
    fw_u32 ready;
    struct { fw_u32 state, family; fw_u64 oid; } known[FAMILIES]; /* churners: what there must be */
} report;

static struct board {
    fw_u32 stop, torn, lost, frozen;
    fw_u64 reads, writes, changes, refused;
    char what[256];
    report reports[ACTORS];
} *board;

typedef unsigned long ul; /* what printf calls %lu */

static const char *name_;
static uint32_t kind_;
static uint64_t random_;
static fw_db *db; /* of this process */

static uint64_t draw(uint64_t n) { /* splitmix64 */
    uint64_t z = random_ += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return (z ^ z >> 31) % n;
}

static void nap(int64_t ns) { fw_platform_sleep_until(fw_platform_monotonic_ns() + ns); }
static uint32_t get(fw_u32 *a) { return FW_LOAD(*a, acquire); }
static void set(fw_u32 *a, uint32_t v) { FW_STORE(*a, v, release); }

/* The first thing that broke is told; all are counted. */
__attribute__((format(printf, 2, 3))) static void broken(fw_u32 *count, const char *what, ...) {
    va_list args;
    va_start(args, what);
    if (atomic_fetch_add(count, 1) == 0 && !board->what[0]) vsnprintf(board->what, sizeof board->what, what, args);
    va_end(args);
}

static void child_fails(const char *what, long r) {
    fprintf(stderr, "%s: %ld\n", what, r);
    _exit(10);
}

/* -- values ------------------------------------------------------------------------------------------------------------ */

static uint64_t word_of(uint64_t oid, uint64_t w) { return w * 0x9e3779b97f4a7c15u + oid; }

static void fill(uint64_t *words, uint32_t n, uint64_t word) {
    for (uint32_t i = 0; i < n; i++) words[i] = word;
}

static int is_whole(const volatile uint64_t *words, uint32_t n, uint64_t word) {
    for (uint32_t i = 0; i < n; i++)
        if (words[i] != word) return 0;
    return 1;
}

/* -- the objects that are always there --------------------------------------------------------------------------------- */

static const struct { const char *name; uint32_t size, n_slots, flags; } specs[OBJECTS] = {
    {"cause", 16, 64, 0}, {"effect", 16, 64, 0}, {"small", 200, 64, 0}, {"middle", 4096, 32, FW_NO_NOTIFY},
    {"large", LARGE, 56, 0}, {"public", 64, 16, FW_PUBLIC_WRITE},
};
enum { CAUSE, EFFECT, SMALL, MIDDLE, LARGE_ONE, PUBLIC };

typedef struct { fw_handle handle; uint64_t oid, last; uint32_t size; } known;

static void insert_sets(void) {
    for (unsigned s = 0; s < SETS; s++) {
        char name[32];
        snprintf(name, sizeof name, "writer%u", s);
        int c = fw_join(db, name, NULL);
        if (c < 0) child_fails("join", c);
        for (unsigned k = 0; k < OBJECTS + FILLERS / SETS; k++) {
            fw_spec spec = {.size = 8, .n_slots = 4, .every = 1, .component = (uint32_t)c, .n_causes = 1,
                            .flags = FW_PERSISTENT};
            if (k < OBJECTS) { spec.size = specs[k].size; spec.n_slots = specs[k].n_slots; spec.flags |= specs[k].flags; }
            if (k < OBJECTS) snprintf(spec.name, sizeof spec.name, "%s/%s", name, specs[k].name);
            else snprintf(spec.name, sizeof spec.name, "%s/filler%u", name, k);
            fw_handle h = fw_insert(db, &spec);
            if (h < 0) child_fails(spec.name, (long)h);
        }
        fw_leave(db, (uint32_t)c);
    }
}

static void find_sets(known objects[SETS][OBJECTS]) {
    for (unsigned s = 0; s < SETS; s++)
        for (unsigned k = 0; k < OBJECTS; k++) {
            char name[32];
            fw_object o;
            snprintf(name, sizeof name, "writer%u/%s", s, specs[k].name);
            fw_handle h = fw_find(db, name);
            if (h < 0 || fw_object_get(db, h, &o) < 0) { broken(&board->lost, "%s is lost: %ld", name, (long)h); _exit(11); }
            objects[s][k] = (known){h, o.oid, 0, o.spec.size};
        }
}

/* -- roles: each round ends with a sign of progress --------------------------------------------------------------------- */

static int participates(int role) { return kind_ == FW_BARRIER && (role == WRITER || role == READER || role == CHURNER); }

static int join(int role, unsigned number) {
    char name[32];
    snprintf(name, sizeof name, "%s%u", role_names[role], number);
    int c = fw_join(db, name, &(fw_join_opts){.participant = (uint32_t)participates(role)});
    if (c < 0) child_fails(name, c);
    return c;
}

/* Ends a round: in a barrier store, says that the cycle is done and waits for the next. */
static void end_round(report *self, int role, int component) {
    if (participates(role)) {
        static uint64_t cycle;
        fw_done(db, (uint32_t)component, cycle ? cycle : fw_cycle(db));
        int64_t c;
        do c = fw_step(db, (uint32_t)component, 100000000); while (c < 0 && !get(&board->stop));
        cycle = c > 0 ? (uint64_t)c : 0;
    }
    FW_FETCH_ADD(self->progress, 1);
}

static void written(int64_t w) {
    if (w > 0) FW_FETCH_ADD(board->writes, 1);
    else if (w == -EBUSY) FW_FETCH_ADD(board->refused, 1);
    else child_fails("write", (long)w);
}

static int64_t write_value(report *self, known *o, const fw_cause *cause) {
    static uint64_t words[WORDS_MAX];
    fw_object state;
    int r = fw_object_get(db, o->handle, &state);
    if (r < 0) child_fails("object", r);
    fill(words, o->size / 8, word_of(o->oid, state.head + 1));
    set(&self->place, IN_WRITE);
    int64_t w = fw_write(db, o->handle, words, o->size, fw_not_before(db, o->handle, 0), cause, cause ? 1 : 0);
    set(&self->place, ELSEWHERE);
    written(w);
    return w;
}

/* Fills a slot in the store itself, slowly. */
static void fill_value(report *self, known *o) {
    void *slot;
    fw_object state;
    int r = fw_object_get(db, o->handle, &state);
    if (r == 0 && (r = fw_write_begin(db, o->handle, &slot)) == -EBUSY) { written(r); return; }
    if (r < 0) child_fails("begin", r);
    set(&self->place, BEGUN);
    uint32_t quarter = o->size / 8 / 4;
    for (uint32_t k = 0; k < 4; k++) {
        fill((uint64_t *)slot + k * quarter, quarter, word_of(o->oid, state.head + 1));
        nap(20000);
    }
    written(fw_write_commit(db, o->handle, o->size, fw_not_before(db, o->handle, 0), NULL, 0));
    set(&self->place, ELSEWHERE);
}

static void write_public(known *o) {
    uint64_t words[8];
    fill(words, 8, draw(UINT64_MAX));
    int64_t w = fw_write(db, o->handle, words, sizeof words, 0, NULL, 0);
    if (w < 0 && w != -EBUSY) child_fails("public", (long)w);
}

static void play_writer(report *self, unsigned number) {
    known objects[SETS][OBJECTS], *o;
    int c = join(WRITER, number);
    find_sets(objects);
    o = objects[number];
    set(&self->ready, 1);
    while (!get(&board->stop)) {
        fw_object cause, effect; /* write k of the effect follows from write k of the cause */
        if (fw_object_get(db, o[CAUSE].handle, &cause) < 0 || fw_object_get(db, o[EFFECT].handle, &effect) < 0)
            child_fails("pair", 0);
        if (cause.head > effect.head || write_value(self, &o[CAUSE], NULL) > 0)
            write_value(self, &o[EFFECT], &(fw_cause){o[CAUSE].oid, effect.head + 1});
        write_value(self, &o[SMALL], NULL);
        write_value(self, &o[MIDDLE], NULL);
        int64_t w = write_value(self, &o[LARGE_ONE], NULL);
        fill_value(self, &o[LARGE_ONE]);
        write_public(&objects[draw(SETS)][PUBLIC]);
        end_round(self, WRITER, c);
        if (w == -EBUSY) fw_wait_cycle(db, fw_cycle(db), TICK_NS); /* too fast: go on with the next cycle */
    }
}

/* Reads write w; 1 if it was whole, 0 if it had gone. */
static int read_value(known *o, int public, int64_t w) {
    static uint64_t words[WORDS_MAX];
    fw_info info;
    int r = fw_read(db, o->handle, (uint64_t)w, words, sizeof words, &info);
    if (r == -ESTALE) return 0;
    if (r < 0) { broken(&board->torn, "write %ld of object %lu: read says %d", (long)w, (ul)o->oid, r); return 0; }
    FW_FETCH_ADD(board->reads, 1);
    uint64_t word = public ? words[0] : word_of(o->oid, (uint64_t)w);
    if (info.size != o->size || !is_whole(words, o->size / 8, word))
        broken(&board->torn, "write %ld of object %lu is torn", (long)w, (ul)o->oid);
    return 1;
}

static void read_object(known *o, int public) {
    int64_t w = fw_newest(db, o->handle);
    if (w < (int64_t)o->last) broken(&board->torn, "object %lu: write %ld came after %lu", (ul)o->oid, (long)w, (ul)o->last);
    if (w <= 0) return;
    o->last = (uint64_t)w;
    read_value(o, public, w);
    const void *data;
    fw_info info;
    if (fw_peek(db, o->handle, (uint64_t)w, &data, &info) == 0) {
        uint64_t word = public ? *(const volatile uint64_t *)data : word_of(o->oid, (uint64_t)w);
        int whole = info.size == o->size && is_whole(data, o->size / 8, word);
        if (!whole && fw_check(db, o->handle, (uint64_t)w) == 0)
            broken(&board->torn, "write %ld of object %lu is torn in place", (long)w, (ul)o->oid);
    }
    uint64_t lost = 0, after = draw(o->last);
    int64_t next = fw_next(db, o->handle, after, &lost);
    if (next > 0 && (uint64_t)next != after + 1 + lost)
        broken(&board->torn, "next after %lu: %ld, lost %lu", (ul)after, (long)next, (ul)lost);
    int64_t then = fw_as_of(db, o->handle, fw_now_ns(db));
    if (then < w && then != -ESTALE) broken(&board->torn, "as of now: %ld, and newest was %ld", (long)then, (long)w);
}

/* The cut of one of the latest cycles: complete, the same whenever it is asked for, no effect without its cause. */
static void read_cut(known *set_of, uint64_t back) {
    uint64_t c = fw_cycle(db);
    if (c < back) return;
    int64_t shown[OBJECTS], again;
    for (unsigned k = 0; k < OBJECTS; k++) {
        shown[k] = fw_visible(db, set_of[k].handle, c - back);
        if (shown[k] < 0 && shown[k] != -ESTALE && shown[k] != -EAGAIN)
            broken(&board->torn, "object %lu in cycle %lu: %ld", (ul)set_of[k].oid, (ul)(c - back), (long)shown[k]);
        if (shown[k] <= 0) continue;
        int here = read_value(&set_of[k], k == PUBLIC, shown[k]);
        if (!here && back == 0 && fw_cycle(db) == c)
            broken(&board->torn, "object %lu: the newest cut's write %ld is gone", (ul)set_of[k].oid, (long)shown[k]);
    }
    if (shown[EFFECT] > shown[CAUSE] && shown[CAUSE] >= 0)
        broken(&board->torn, "cycle %lu shows effect %ld of cause %ld", (ul)(c - back), (long)shown[EFFECT],
               (long)shown[CAUSE]);
    for (unsigned k = 0; k < OBJECTS; k++)
        if ((again = fw_visible(db, set_of[k].handle, c - back)) != shown[k] && again != -ESTALE)
            broken(&board->torn, "object %lu in cycle %lu was %ld, is %ld", (ul)set_of[k].oid, (ul)(c - back),
                   (long)shown[k], (long)again);
}

/* All objects, those of the churners too, which come and go. */
static void read_directory(void) {
    static uint64_t words[1024];
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        fw_handle h = fw_entry(db, i);
        fw_object o;
        fw_info info;
        if (h < 0 || fw_object_get(db, h, &o) < 0) continue;
        int churns = strncmp(o.spec.name, "churner", 7) == 0, health = strstr(o.spec.name, "/health") != NULL;
        if (!churns && !health && strncmp(o.spec.name, "writer", 6) != 0) broken(&board->lost, "entry %u is called %s", i, o.spec.name);
        if (!churns || health) continue;
        int64_t w = fw_newest(db, h);
        if (w > 0 && fw_read(db, h, (uint64_t)w, words, sizeof words, &info) == 0 &&
            !is_whole(words, info.size / 8, word_of(o.oid, (uint64_t)w)))
            broken(&board->torn, "write %ld of %s is another's", (long)w, o.spec.name);
    }
    for (uint32_t i = 0; i < fw_n_components(db); i++) {
        uint64_t c = fw_cycle(db);
        int alive = fw_alive_at(db, i, c), again = fw_alive_at(db, i, c);
        if (alive != again && again != -ESTALE)
            broken(&board->torn, "component %u in cycle %lu was %d, is %d", i, (ul)c, alive, again);
    }
}

static void play_reader(report *self, unsigned number) {
    known objects[SETS][OBJECTS];
    int c = join(READER, number);
    find_sets(objects);
    set(&self->ready, 1);
    while (!get(&board->stop)) {
        for (unsigned s = 0; s < SETS; s++) {
            for (unsigned k = 0; k < OBJECTS; k++) read_object(&objects[s][k], k == PUBLIC);
            for (uint64_t back = 0; back < 3; back++) read_cut(objects[s], back);
        }
        read_directory();
        end_round(self, READER, c);
        if (kind_ == FW_REAL) nap(500000);
    }
}

static void expect_of_wait(int64_t r, const char *what) {
    if (r < 0 && r != -ETIMEDOUT && r != -EHOSTDOWN && r != -EIDRM) child_fails(what, (long)r);
}

static void play_waiter(report *self, unsigned number) {
    known objects[SETS][OBJECTS];
    join(WAITER, number);
    find_sets(objects);
    set(&self->ready, 1);
    for (unsigned round = number; !get(&board->stop); round++) {
        known *o = &objects[draw(SETS)][draw(OBJECTS)];
        int64_t until = fw_now_ns(db) + TICK_NS, r;
        char name[32];
        snprintf(name, sizeof name, "churner%u/%u", (unsigned)draw(2), (unsigned)draw(FAMILIES));
        fw_handle other = fw_find(db, name);
        set(&self->place, ASLEEP);
        switch (round % 4) {
        case 0:
            r = fw_wait_write(db, o->handle, o->last, until);
            expect_of_wait(r, "wait_write");
            if (r > 0 && r <= (int64_t)o->last) broken(&board->torn, "waited for more than %lu, got %ld", (ul)o->last, (long)r);
            if (r > 0) o->last = (uint64_t)r;
            break;
        case 1: expect_of_wait(fw_wait_cycle(db, fw_cycle(db), 10 * (int64_t)TICK_NS), "wait_cycle"); break;
        case 2: expect_of_wait(fw_wait_directory(db, fw_directory_version(db), TICK_NS), "wait_directory"); break;
        default:
            if (other >= 0) expect_of_wait(fw_wait_write(db, other, (uint64_t)1 << 40, until), "wait for the deletion");
            else nap(TICK_NS);
        }
        set(&self->place, ELSEWHERE);
        FW_FETCH_ADD(self->progress, 1);
    }
}

static void play_clock(report *self) {
    static const volatile int never;
    set(&self->ready, 1);
    child_fails("clock", fw_clock_run(db, NULL, 0, &never));
}

/* -- churners: families of objects, which come and go together ----------------------------------------------------------- */

static void family_name(char *name, unsigned churner, unsigned k, int below) {
    snprintf(name, FW_NAME_MAX, "churner%u/%u%s", churner, k, below == 0 ? "" : below == 1 ? "/child" : "/child/leaf");
}

static fw_handle insert_member(int component, unsigned number, unsigned k, int below, uint64_t parent) {
    fw_spec spec = {.size = 8 * (uint32_t)(1 + draw(700)), .n_slots = 4 + (uint32_t)draw(8), .every = 1 + (uint32_t)draw(2),
                    .component = (uint32_t)component, .parent = parent, .flags = FW_PERSISTENT,
                    .t_history_ns = 1 + (int64_t)draw(2 * TICK_NS)};
    if (below) spec.flags |= FW_WITH_PARENT;
    if (draw(2)) spec.flags |= FW_IMMEDIATE_DELETE;
    family_name(spec.name, number, k, below);
    fw_handle h = fw_insert(db, &spec);
    if (h < 0) child_fails(spec.name, (long)h);
    if (fw_find(db, spec.name) != h) broken(&board->lost, "%s was inserted and is not found", spec.name);
    FW_FETCH_ADD(board->changes, 1);
    return h;
}

static void insert_family(report *self, int component, unsigned number, unsigned k) {
    int family = (int)draw(2);
    fw_object parent;
    set(&self->known[k].family, (uint32_t)family);
    set(&self->known[k].state, INSERTING);
    fw_handle h = insert_member(component, number, k, 0, 0);
    if (fw_object_get(db, h, &parent) < 0) child_fails("object", 0);
    if (family) {
        fw_object child;
        fw_handle below = insert_member(component, number, k, 1, parent.oid);
        if (fw_object_get(db, below, &child) < 0) child_fails("object", 0);
        insert_member(component, number, k, 2, child.oid);
    }
    FW_STORE(self->known[k].oid, parent.oid, relaxed);
    set(&self->known[k].state, PRESENT);
}

static void delete_family(report *self, unsigned number, unsigned k) {
    char name[FW_NAME_MAX];
    family_name(name, number, k, 0);
    fw_handle h = fw_find(db, name);
    if (h < 0) { broken(&board->lost, "%s is lost: %ld", name, (long)h); _exit(11); }
    set(&self->known[k].state, DELETING);
    int r = fw_delete(db, h);
    if (r < 0) child_fails("delete", r);
    if (fw_find(db, name) >= 0) broken(&board->lost, "%s was deleted and is found", name);
    set(&self->known[k].state, ABSENT);
    FW_FETCH_ADD(board->changes, 1);
}

static void write_member(unsigned number, unsigned k) {
    static uint64_t words[1024];
    char name[FW_NAME_MAX];
    fw_object o;
    family_name(name, number, k, 0);
    fw_handle h = fw_find(db, name);
    if (h < 0 || fw_object_get(db, h, &o) < 0) return;
    fill(words, o.spec.size / 8, word_of(o.oid, o.head + 1));
    written(fw_write(db, h, words, o.spec.size, 0, NULL, 0));
}

/* A component that comes, and goes again in the same process. */
static void come_and_go(unsigned number) {
    char name[32], schema[64];
    snprintf(name, sizeof name, "churner%u-guest%u", number, (unsigned)draw(2));
    int c = fw_join(db, name, NULL);
    if (c < 0) child_fails(name, c);
    fw_leave(db, (uint32_t)c);
    int n = snprintf(schema, sizeof schema, "{\"name\":\"Churn%u\"}", (unsigned)draw(32));
    if ((c = fw_schema_add(db, schema, (uint32_t)n)) < 0) child_fails("schema", c);
}

static void play_churner(report *self, unsigned number) {
    int c = join(CHURNER, number);
    for (unsigned k = 0; k < FAMILIES; k++) { /* what the predecessor left half done is in the state that it is in */
        char name[FW_NAME_MAX];
        fw_object o;
        family_name(name, number, k, 0);
        fw_handle h = fw_find(db, name);
        uint32_t state = get(&self->known[k].state);
        if (h >= 0 && fw_object_get(db, h, &o) < 0) child_fails("object", 0);
        if (h >= 0 && state == INSERTING) delete_family(self, number, k); /* not all of the family may be there */
        else if (h >= 0) { FW_STORE(self->known[k].oid, o.oid, relaxed); set(&self->known[k].state, PRESENT); }
        else set(&self->known[k].state, ABSENT);
    }
    set(&self->ready, 1);
    while (!get(&board->stop)) {
        unsigned k = (unsigned)draw(FAMILIES);
        if (get(&self->known[k].state) == ABSENT) insert_family(self, c, number, k);
        else if (draw(3)) delete_family(self, number, k);
        else write_member(number, k);
        if (draw(20) == 0) come_and_go(number);
        end_round(self, CHURNER, c);
        if (kind_ == FW_REAL) nap(20000);
    }
}

/* -- the supervisor ------------------------------------------------------------------------------------------------------- */

static pid_t pids[ACTORS];
static uint64_t kills_of[ROLES], in_write, begun, asleep, in_tick, in_change, within_one, slowest[2];

static void end_all(void) {
    for (unsigned a = 0; a < ACTORS; a++)
        if (pids[a] > 0) { kill(pids[a], SIGKILL); waitpid(pids[a], NULL, 0); pids[a] = 0; }
}

static void give_up(const char *what, long r) {
    fprintf(stderr, "%s: %ld\n", what, r);
    end_all();
    if (db) fw_close(db);
    exit(2);
}

static void start(unsigned a) {
    report *self = &board->reports[a];
    uint64_t seed = draw(UINT64_MAX);
    set(&self->ready, 0);
    set(&self->place, ELSEWHERE);
    fflush(NULL);
    pids[a] = fork();
    if (pids[a] < 0) give_up("fork", errno);
    if (pids[a] > 0) return;
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    fw_forget(db);
    random_ = seed;
    int r = fw_attach(&db, name_);
    if (r < 0) child_fails("attach", r);
    switch (cast[a].role) {
    case CLOCK: play_clock(self); break;
    case WRITER: play_writer(self, cast[a].number); break;
    case READER: play_reader(self, cast[a].number); break;
    case WAITER: play_waiter(self, cast[a].number); break;
    default: play_churner(self, cast[a].number);
    }
    fw_close(db);
    _exit(0);
}

static int survivors_live(void) {
    for (unsigned a = 0; a < ACTORS; a++) {
        int status;
        if (pids[a] <= 0 || waitpid(pids[a], &status, WNOHANG) == 0) continue;
        broken(&board->frozen, "%s%u died by itself: status %d", role_names[cast[a].role], cast[a].number, status);
        pids[a] = 0;
        return 0;
    }
    return 1;
}

/* Waits until the cycle and every living process have gone on. Counts the cycles that this took; those of a barrier store
 * last as long as its participants need, and so others do not count there. */
static int all_go_on(void) {
    uint64_t before[ACTORS], c0 = fw_cycle(db), counted = 0;
    int gone_on[ACTORS], left;
    int64_t deadline = fw_platform_monotonic_ns() + WATCHDOG_S * (int64_t)1000000000;
    for (unsigned a = 0; a < ACTORS; a++) {
        before[a] = FW_LOAD(board->reports[a].progress, acquire);
        gone_on[a] = pids[a] <= 0 || cast[a].role == CLOCK;
    }
    do {
        uint64_t cycles = fw_cycle(db) - c0;
        left = cycles == 0;
        for (unsigned a = 0; a < ACTORS; a++) {
            if (gone_on[a]) continue;
            gone_on[a] = FW_LOAD(board->reports[a].progress, acquire) != before[a];
            left += !gone_on[a];
            if (gone_on[a] && cycles > counted && (kind_ == FW_REAL || participates(cast[a].role))) counted = cycles;
            uint64_t most = participates(cast[a].role) ? 2 : MANY_CYCLES; /* a barrier's cycle does not end without it */
            if (!gone_on[a] && (cycles > most || fw_platform_monotonic_ns() > deadline)) {
                broken(&board->frozen, "%s%u does not go on: cycle %lu", role_names[cast[a].role], cast[a].number,
                       (ul)(c0 + cycles));
                return 0;
            }
        }
        if (!survivors_live()) return 0;
        if (!cycles && fw_platform_monotonic_ns() > deadline) {
            broken(&board->frozen, "cycle %lu does not end", (ul)c0);
            return 0;
        }
        if (left) nap(100000);
    } while (left);
    within_one += counted <= 1;
    if (counted > slowest[kind_ == FW_REAL]) slowest[kind_ == FW_REAL] = counted;
    return 1;
}

static int all_ready(void) {
    int64_t deadline = fw_platform_monotonic_ns() + WATCHDOG_S * (int64_t)1000000000;
    for (unsigned a = 0; a < ACTORS; a++)
        while (!get(&board->reports[a].ready)) {
            if (!survivors_live()) return 0;
            if (fw_platform_monotonic_ns() > deadline) {
                broken(&board->frozen, "%s%u does not come up", role_names[cast[a].role], cast[a].number);
                return 0;
            }
            nap(100000);
        }
    return 1;
}

/* What a dead churner's store must show, once somebody else has changed the directory. */
static void check_families(unsigned a) {
    for (unsigned k = 0; k < FAMILIES; k++) {
        uint32_t state = get(&board->reports[a].known[k].state), family = get(&board->reports[a].known[k].family);
        int there[3];
        fw_object o = {0};
        char name[FW_NAME_MAX];
        for (int below = 2; below >= 0; below--) {
            family_name(name, cast[a].number, k, below);
            fw_handle h = fw_find(db, name);
            there[below] = h >= 0 && fw_object_get(db, h, &o) == 0;
        }
        int n = there[0] + there[1] + there[2], all = family ? 3 : 1;
        if (state == ABSENT && n) broken(&board->lost, "%s was deleted and is there", name);
        if (state == PRESENT && (n != all || o.oid != FW_LOAD(board->reports[a].known[k].oid, relaxed)))
            broken(&board->lost, "%s: %d of %d are there", name, n, all);
        if (state == DELETING && n && n != all) broken(&board->lost, "%s is deleted by half: %d of %d", name, n, all);
        if (state == INSERTING && (there[1] > there[0] || there[2] > there[1]))
            broken(&board->lost, "%s: a child without its parent", name);
    }
}

static void check_directory(void) {
    char text[200];
    int r = fw_directory_open(db); /* carries out what was begun */
    if (r < 0) { broken(&board->frozen, "the directory is locked: %d", r); return; }
    const char *not = inconsistent(db, text, sizeof text);
    fw_directory_close(db);
    if (not) broken(&board->lost, "%s", not);
}

static unsigned choose(void) {
    unsigned at = (unsigned)draw(100), a = 0;
    while (at >= cast[a].share) at -= cast[a++].share;
    if (cast[a].role == CLOCK && draw(4)) { /* mostly the one that ticks */
        fw_clock_state clock;
        fw_clock_get(db, &clock);
        for (unsigned k = 0; k < 2; k++)
            if (pids[k] == clock.pid) a = k;
    }
    return a;
}

/* In the middle of what it does for the store: of a write, a tick, a change of the directory. */
static int is_busy(unsigned a) {
    if (cast[a].role == WRITER) return get(&board->reports[a].place) == IN_WRITE;
    if (cast[a].role == CLOCK) return FW_LOAD(db->clock->edge.epoch, acquire) > fw_cycle(db);
    return cast[a].role == CHURNER && get(&db->dir->intent.kind) != FW_NOTHING;
}

/* A random moment; of half of them, the first one behind it that finds the victim busy. */
static void wait_a_moment(unsigned a) {
    nap((int64_t)draw(2000000));
    if (draw(2)) return;
    int64_t deadline = fw_platform_monotonic_ns() + TICK_NS, then = (int64_t)draw(20000);
    while (!is_busy(a) && fw_platform_monotonic_ns() < deadline) ;
    deadline = fw_platform_monotonic_ns() + then;
    while (fw_platform_monotonic_ns() < deadline) ;
}

static int kill_one(void) {
    unsigned a = choose();
    if (cast[a].role == READER || cast[a].role == WAITER) nap((int64_t)draw(2000000));
    else wait_a_moment(a);
    kill(pids[a], SIGKILL);
    waitpid(pids[a], NULL, 0);
    pids[a] = 0;
    kills_of[cast[a].role]++;
    uint32_t place = get(&board->reports[a].place);
    in_write += place == IN_WRITE;
    begun += place == BEGUN;
    asleep += place == ASLEEP;
    in_tick += cast[a].role == CLOCK && is_busy(a);
    in_change += cast[a].role == CHURNER && is_busy(a);
    if (!all_go_on()) return 0;
    if (cast[a].role == CHURNER || draw(4) == 0) check_directory();
    if (cast[a].role == CHURNER) check_families(a);
    start(a);
    return all_ready() && !get(&board->torn) && !get(&board->lost);
}

/* Deletes everything, lets its history pass, and counts what is unused. */
static uint64_t leaked(void) {
    int r = fw_clock_take(db), c = -1;
    if (r < 0) give_up("clock", r);
    for (uint32_t i = 0; i < fw_n_components(db); i++) {
        fw_component o;
        if (fw_component_get(db, i, &o) == 0 && (c = fw_join(db, o.name, NULL)) < 0)
            broken(&board->frozen, "%s cannot be taken over: %d", o.name, c);
    }
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        fw_object o;
        fw_handle h = fw_entry(db, i);
        if (h < 0 || fw_object_get(db, h, &o) < 0 || o.t_delete_ns != INT64_MAX) continue;
        if ((r = fw_delete(db, h)) < 0) broken(&board->lost, "%s cannot be deleted: %d", o.spec.name, r);
    }
    if (kind_ == FW_REAL) nap(70 * (int64_t)TICK_NS); /* the longest history */
    for (int i = 0; i < 70; i++) fw_tick(db);
    fw_spec huge = {.name = "probe", .size = 1u << 30, .n_slots = 4, .every = 1, .component = (uint32_t)c};
    if (fw_insert(db, &huge) != -ENOSPC) broken(&board->lost, "there is room for what is larger than the store");
    check_directory();
    uint64_t size, unused;
    fw_memory(db, &size, &unused);
    return size - unused;
}

static uint64_t elapsed_ms(int64_t since_ns) { return (uint64_t)(fw_platform_monotonic_ns() - since_ns) / 1000000; }

int main(int argc, char **argv) {
    if (argc < 4 || argc > 5) { fprintf(stderr, "usage: kills NAME COUNT SEED [PROGRESS]\n"); return 2; }
    long count = atol(argv[2]), every = argc == 5 ? atol(argv[4]) : 0, done = 0;
    uint64_t leak = 0, cycles = 0, takeovers = 0;
    int64_t begun_ns = fw_platform_monotonic_ns();
    name_ = argv[1];
    random_ = (uint64_t)atoll(argv[3]);
    board = mmap(NULL, sizeof *board, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (board == MAP_FAILED) { fprintf(stderr, "mmap: %d\n", errno); return 2; }
    int whole = 1;
    for (kind_ = FW_REAL; whole && kind_ >= FW_BARRIER; kind_--) {
        fw_opts opts = {.size = 48u << 20, .max_objects = 1024, .max_components = 32, .clock = kind_, .tick_ns = TICK_NS};
        int r = fw_create(&db, name_, &opts);
        if (r < 0) give_up("create", r);
        memset(board->reports, 0, sizeof board->reports);
        set(&board->stop, 0);
        insert_sets();
        for (unsigned a = 0; a < ACTORS; a++) start(a);
        whole = all_ready() && all_go_on();
        for (long end = kind_ == FW_REAL ? (count + 1) / 2 : count; whole && done < end; done++) {
            whole = kill_one();
            if (every && (done + 1) % every == 0)
                fprintf(stderr, "%ld kills, %lu s\n", done + 1, (ul)elapsed_ms(begun_ns) / 1000);
        }
        whole = whole && all_go_on();
        fw_clock_state clock;
        fw_clock_get(db, &clock);
        cycles += clock.cycle;
        takeovers += clock.takeovers;
        end_all();
        if (whole) leak += leaked();
        fw_close(db);
    }
    if (board->what[0]) printf("%s\n", board->what);
    const struct { const char *name; uint64_t n; } counts[] = {
        {"kills", (uint64_t)done}, {"clock", kills_of[CLOCK]}, {"writer", kills_of[WRITER]}, {"reader", kills_of[READER]},
        {"waiter", kills_of[WAITER]}, {"churner", kills_of[CHURNER]}, {"in_write", in_write},
        {"between_begin_and_commit", begun}, {"in_tick", in_tick}, {"in_change", in_change}, {"asleep", asleep},
        {"takeovers", takeovers}, {"within_one_cycle", within_one}, {"most_cycles_real", slowest[1]},
        {"most_cycles_barrier", slowest[0]}, {"cycles", cycles}, {"reads", FW_LOAD(board->reads, relaxed)},
        {"writes", FW_LOAD(board->writes, relaxed)}, {"refused", FW_LOAD(board->refused, relaxed)},
        {"changes", FW_LOAD(board->changes, relaxed)}, {"milliseconds", elapsed_ms(begun_ns)}, {"torn", get(&board->torn)},
        {"lost", get(&board->lost)}, {"frozen", get(&board->frozen)}, {"leaked", leak},
    };
    for (size_t i = 0; i < sizeof counts / sizeof counts[0]; i++)
        printf("%s%s %lu", i ? " " : "", counts[i].name, (ul)counts[i].n);
    printf("\n");
    return whole && !get(&board->torn) && !get(&board->lost) && !get(&board->frozen) && !leak ? 0 : 1;
}
