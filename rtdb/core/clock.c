/* clock.c - ticks: stepped by a caller, at a barrier, or in real time; who takes over; who died. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <pthread.h>
#include <stdlib.h>
#include <unistd.h>

#include "fw_layout.h"

uint64_t fw_cycle(const fw_db *db) { return FW_LOAD(db->clock->edge.cycle, acquire); }

int64_t fw_now_ns(const fw_db *db) {
    if (db->header->kind == FW_REAL) return fw_platform_monotonic_ns() + db->header->offset_ns;
    return fw_t0_ns(db) + (int64_t)fw_cycle(db) * db->header->tick_ns;
}

static int64_t edge_ns(const fw_db *db, uint64_t cycle) { return fw_t0_ns(db) + (int64_t)cycle * db->header->tick_ns; }

void fw_clock_get(const fw_db *db, fw_clock_state *out) {
    *out = (fw_clock_state){.kind = db->header->kind, .alive = db->has_clock || (db->fd >= 0 && fw_lock_held(db, FW_LOCK_CLOCK)),
                            .pid = (int64_t)FW_LOAD(db->clock->pid, relaxed), .cycle = fw_cycle(db),
                            .skipped = FW_LOAD(db->clock->skipped, relaxed), .takeovers = FW_LOAD(db->clock->takeovers, relaxed)};
    if (out->kind == FW_REAL && out->cycle) out->late_ns = fw_now_ns(db) - edge_ns(db, out->cycle + 1);
    if (out->late_ns < 0) out->late_ns = 0;
    for (uint32_t k = 0; k < FW_BINS; k++) out->lateness_us[k] = FW_LOAD(db->clock->lateness_us[k], relaxed);
}

int fw_clock_take(fw_db *db) {
    if (db->has_clock) return 0;
    int r = fw_lock(db, FW_LOCK_CLOCK, F_WRLCK);
    if (r < 0) return r;
    for (int i = 0; i < 1000 && fw_lock_held(db, FW_LOCK_MARK); i++) fw_platform_sleep_until(fw_platform_monotonic_ns() + 100000);
    r = fw_writable(db, db->map.clock, db->map.heap - db->map.clock, 1);
    if (r < 0) { fw_lock(db, FW_LOCK_CLOCK, F_UNLCK); return r; }
    if (fw_cycle(db)) FW_STORE(db->clock->takeovers, FW_LOAD(db->clock->takeovers, relaxed) + 1, relaxed);
    FW_STORE(db->clock->pid, (uint64_t)getpid(), relaxed);
    db->has_clock = 1;
    db->cuts_mapped = db->map.size;
    db->version = UINT64_MAX;
    return 0;
}

static void clock_release(fw_db *db) {
    fw_writable(db, db->map.clock, db->map.size - db->map.clock, 0);
    for (uint32_t i = 0; i < fw_n_entries(db); i++) { /* that took our own rings too */
        if (fw_ref_fill(db, i) < 0) continue;
        db->refs[i].public_mapped = 0;
        if (db->self[db->refs[i].component].owned) fw_ring_writable(db, &db->refs[i], 1);
    }
    db->has_clock = 0;
    fw_lock(db, FW_LOCK_CLOCK, F_UNLCK);
}

/* Makes cut logs writable, down to where the lowest one is now. */
static int map_cuts(fw_db *db, uint64_t cuts_off) {
    if (db->fd < 0 || cuts_off >= db->cuts_mapped) return 0;
    uint64_t low = FW_LOAD(db->dir->heap_high, acquire) / FW_PAGE * FW_PAGE;
    if (cuts_off < low || low < db->map.heap) return -EPROTO;
    int r = fw_writable(db, low, db->map.size - low, 1);
    if (r == 0) db->cuts_mapped = low;
    return r;
}

/* Brings what this process remembers of all objects up to date, and makes their cut logs writable. */
static int refresh(fw_db *db) {
    uint64_t c = fw_cycle(db) + 1; /* what was due in a cycle that is left out is due at the next tick */
    uint64_t version = fw_directory_version(db);
    if (version == db->version) return 0;
    db->n_ticked = fw_n_entries(db);
    for (uint32_t i = 0; i < db->n_ticked; i++) {
        fw_ref *ref = &db->refs[i];
        int r = fw_ref_fill(db, i);
        if (r == -EPROTO) return r;
        if (r == 0 && (r = map_cuts(db, (uint64_t)((uint8_t *)ref->cuts - db->base))) < 0) return r;
        ref->due = UINT64_MAX;
        if (r == 0 && !FW_LOAD(db->life[i].deleted, acquire))
            ref->due = c + (ref->every + ref->phase - c % ref->every) % ref->every;
    }
    db->version = version;
    return 0;
}

/* Notes who lives; wakes who waits for something of one who died. */
static void note_lives(fw_db *db, uint64_t c) {
    for (uint32_t i = 0, n = fw_n_components(db); i < n; i++) {
        fw_cuts *log = fw_life_log(db, i);
        uint64_t k = FW_LOAD(log->head, relaxed), now = k ? FW_LOAD(fw_log(log)[(k - 1) % FW_LIVES].write, relaxed) : 0;
        uint64_t lives = 1 + (uint64_t)fw_component_alive(db, i);
        if (lives == now || (k && FW_LOAD(fw_log(log)[(k - 1) % FW_LIVES].cycle, relaxed) == c)) continue;
        fw_cut_append(log, FW_LIVES, c, now, lives);
        if (lives == 2) continue;
        for (uint32_t o = 0, m = fw_n_entries(db); o < m; o++)
            if (FW_LOAD(db->life[o].life, acquire) % 2 && db->objects[o].spec.component == i) fw_tell(db, &db->object_wake[o]);
        fw_tell(db, &db->wake->done);
    }
}

int fw_mark_dead(fw_db *db) {
    if (db->fd < 0) return 0;
    int held = db->has_clock, r = held ? 0 : fw_lock(db, FW_LOCK_MARK, F_WRLCK);
    if (r < 0) return r;
    if (!held && fw_lock_held(db, FW_LOCK_CLOCK)) { /* whoever takes the clock after this waits for us: fw_clock_take */
        fw_lock(db, FW_LOCK_MARK, F_UNLCK);
        return -EBUSY;
    }
    if (!held) r = fw_writable(db, db->map.lives, db->map.heap - db->map.lives, 1);
    if (r == 0) note_lives(db, fw_cycle(db));
    if (!held) {
        fw_writable(db, db->map.lives, db->map.heap - db->map.lives, 0);
        fw_lock(db, FW_LOCK_MARK, F_UNLCK);
    }
    return r;
}

/* In real time: who was due in the cycle that ends and is not done with it has missed it. */
static void note_missed(fw_db *db, uint64_t cycle) {
    for (uint32_t i = 0, n = fw_n_components(db); i < n; i++) {
        const fw_centry *e = &db->components[i];
        fw_cuts *log = fw_life_log(db, i);
        if (FW_LOAD(log->now, relaxed) != 2) continue; /* the dead owe nothing */
        if (e->participant && cycle % (e->every ? e->every : 1) == e->phase && FW_LOAD(db->done[i], relaxed) < cycle)
            FW_STORE(db->missed[i], FW_LOAD(db->missed[i], relaxed) + 1, relaxed);
    }
}

/* Ends the current cycle; c is the new one. */
static int tick_to(fw_db *db, uint64_t c) {
    note_lives(db, c);
    fw_tick_begin(&db->clock->edge, c);
    int r = refresh(db); /* behind the fence of the epoch: with delete_one */
    if (r < 0) return r;
    for (uint32_t i = 0; i < db->n_ticked; i++) { /* not those that were inserted since: the next tick knows them */
        fw_ref *ref = &db->refs[i];
        if (ref->due > c) continue;
        fw_tick_object(ref->ring, ref->cuts, ref->n_slots, c);
        ref->due = ref->every == 1 ? c + 1 : c + ref->every - (c + ref->every - ref->phase) % ref->every;
    }
    fw_tick_end(&db->clock->edge, c);
    fw_tell(db, &db->wake->clock);
    return 0;
}

/* The tick that a dead clock left half done is finished before any other: its cut may show in part already. */
static int finish_tick(fw_db *db) {
    uint64_t epoch = FW_LOAD(db->clock->edge.epoch, relaxed);
    return epoch > fw_cycle(db) ? tick_to(db, epoch) : 0;
}

int64_t fw_tick(fw_db *db) {
    if (!db->has_clock) return -EPERM;
    uint64_t c = fw_cycle(db) + 1, epoch = FW_LOAD(db->clock->edge.epoch, relaxed);
    if (epoch > c) c = epoch;
    int r = tick_to(db, c);
    return r < 0 ? r : (int64_t)c;
}

/* -- a clock that runs by itself ------------------------------------------------------------------------------------- */

static int is_stopped(const volatile int *stop) { return __atomic_load_n(stop, __ATOMIC_RELAXED); }

static int all_here(fw_db *db, const char *const *wait_for, uint32_t n) {
    for (uint32_t k = 0; k < n; k++) {
        int here = 0;
        for (uint32_t i = 0; i < fw_n_components(db) && !here; i++)
            here = strncmp(db->components[i].name, wait_for[k], FW_NAME_MAX) == 0 && fw_component_alive(db, i);
        if (!here) return 0;
    }
    return 1;
}

static int participants_live(const fw_db *db) {
    for (uint32_t i = 0; i < fw_n_components(db); i++)
        if (db->components[i].participant && fw_component_alive(db, i)) return 1;
    return 0;
}

static int run_barrier(fw_db *db, const volatile int *stop) {
    while (!is_stopped(stop)) {
        int r = participants_live(db) ? fw_wait_done(db, fw_cycle(db), 100000000)
                                      : fw_wait_directory(db, fw_directory_version(db), 10000000); /* nobody to wait for */
        if (r == 0 && !participants_live(db)) continue;
        if (r == -ETIMEDOUT || r == -EINTR) continue;
        if (r == 0 && (r = tick_to(db, fw_cycle(db) + 1)) == 0) continue;
        return r;
    }
    return 0;
}

static int run_real(fw_db *db, const volatile int *stop) {
    int64_t tick_ns = db->header->tick_ns, offset_ns = db->header->offset_ns;
    while (!is_stopped(stop)) {
        uint64_t next = fw_cycle(db) + 1;
        int64_t deadline = edge_ns(db, next) - offset_ns, now = fw_platform_monotonic_ns();
        if (now < deadline - 100000000) { fw_platform_sleep_until(now + 100000000); continue; } /* stop is looked at */
        fw_platform_sleep_until(deadline);
        int64_t late = fw_platform_monotonic_ns() - deadline;
        if (late < 0) continue; /* a signal */
        uint64_t left_out = (uint64_t)(late / tick_ns);
        fw_u32 *bin = &db->clock->lateness_us[fw_bin_of(late)];
        FW_STORE(*bin, FW_LOAD(*bin, relaxed) + 1, relaxed);
        if (left_out) FW_STORE(db->clock->skipped, FW_LOAD(db->clock->skipped, relaxed) + left_out, relaxed);
        note_missed(db, next - 1);
        int r = tick_to(db, next + left_out);
        if (r < 0) return r;
    }
    return 0;
}

int fw_clock_run(fw_db *db, const char *const *wait_for, uint32_t n, const volatile int *stop) {
    uint32_t kind = db->header->kind;
    if (db->fd < 0 || kind == FW_STEPPED) return -EINVAL;
    int64_t look_ns = db->header->tick_ns / 4 < 5000000 ? db->header->tick_ns / 4 : 5000000;
    int r;
    while ((r = fw_clock_take(db)) == -EBUSY && !is_stopped(stop)) fw_platform_sleep_until(fw_platform_monotonic_ns() + look_ns);
    if (r < 0) return is_stopped(stop) && r == -EBUSY ? 0 : r;
    while (!fw_cycle(db) && !is_stopped(stop) && !all_here(db, wait_for, n)) {
        r = fw_wait_directory(db, fw_directory_version(db), look_ns);
        if (r < 0 && r != -ETIMEDOUT && r != -EINTR) return r;
    }
    r = finish_tick(db);
    if (!fw_cycle(db) && kind == FW_REAL) FW_STORE(db->clock->t0_ns, (uint64_t)fw_now_ns(db), release); /* edge 0 is now */
    if (r == 0) r = kind == FW_REAL ? run_real(db, stop) : run_barrier(db, stop);
    clock_release(db);
    return r;
}

struct fw_clock_thread {
    pthread_t thread;
    fw_db *db;
    const char **wait_for;
    uint32_t n;
    volatile int stop;
    int result;
};

static void *run_thread(void *arg) {
    fw_clock_thread *clock = arg;
    clock->result = fw_clock_run(clock->db, clock->wait_for, clock->n, &clock->stop);
    return NULL;
}

static void thread_free(fw_clock_thread *clock) {
    for (uint32_t i = 0; clock->wait_for && i < clock->n; i++) free((void *)(uintptr_t)clock->wait_for[i]);
    free(clock->wait_for);
    if (clock->db) fw_close(clock->db);
    free(clock);
}

int fw_clock_start(fw_clock_thread **out, const char *name, const char *const *wait_for, uint32_t n) {
    fw_clock_thread *clock = calloc(1, sizeof *clock);
    if (!clock) return -ENOMEM;
    int r = fw_attach(&clock->db, name);
    if (r == 0 && clock->db->header->kind == FW_STEPPED) r = -EINVAL;
    clock->wait_for = calloc(n + 1, sizeof *clock->wait_for);
    for (uint32_t i = 0; clock->wait_for && i < n && r == 0; i++, clock->n++)
        if (!(clock->wait_for[i] = strdup(wait_for[i]))) r = -ENOMEM;
    if (!clock->wait_for) r = -ENOMEM;
    if (r == 0) r = -pthread_create(&clock->thread, NULL, run_thread, clock);
    if (r < 0) { thread_free(clock); return r; }
    *out = clock;
    return 0;
}

void fw_clock_forget(fw_clock_thread *clock) { thread_free(clock); }

int fw_clock_stop(fw_clock_thread *clock) {
    __atomic_store_n(&clock->stop, 1, __ATOMIC_RELAXED);
    pthread_join(clock->thread, NULL);
    int r = clock->result;
    thread_free(clock);
    return r;
}
