/* wait.c - waiting for a word of the segment until a condition holds; see protocol.h for why nobody sleeps for ever. */
#include "fw_layout.h"

/* How long a sleeper trusts that it will be woken. A notifier that is killed between changing the word and waking leaves
 * who sleeps to the next notify, or to this. */
static int64_t trust_ns(const fw_db *db) {
    int64_t tick_ns = db->header->tick_ns;
    return tick_ns < 10000000 ? 10000000 : tick_ns > 100000000 ? 100000000 : tick_ns;
}

void fw_tell(fw_db *db, fw_u32 *word) {
    if (db->can_wake) fw_notify(word);
}

int64_t fw_wait_for(fw_db *db, fw_u32 *word, int64_t (*ready)(fw_db *, const void *), const void *what, int64_t deadline_ns) {
    for (;;) {
        int64_t r = ready(db, what);
        if (r) return r;
        uint32_t seen = db->can_wake ? fw_announce(word) : 0;
        if ((r = ready(db, what))) return r;
        int64_t now = fw_platform_monotonic_ns(), left = deadline_ns - now;
        if (left <= 0) return -ETIMEDOUT;
        if (!db->can_wake) { fw_platform_sleep_until(now + 1000000); continue; } /* a store of somebody else: look again */
        r = fw_platform_wait(word, seen, left < trust_ns(db) ? left : trust_ns(db));
        if (r == -EINTR) return r;
    }
}

#define GRACE_NS 200000000 /* for a standby, before a store without a clock is said to be dead */

typedef struct { fw_handle object; uint64_t after; int64_t t_ns; fw_ref *ref; int64_t dead_since_ns; } awaited;

static int64_t written(fw_db *db, const void *what) {
    awaited *a = (awaited *)(uintptr_t)what;
    uint64_t head = FW_LOAD(a->ref->ring->head, acquire);
    if (head > a->after && head < INT64_MAX) return fw_life_still(&db->life[fw_index_of(a->object)].life, a->ref->life) ? -EIDRM : (int64_t)head;
    if (FW_LOAD(db->life[fw_index_of(a->object)].deleted, acquire) ||
        FW_LOAD(db->life[fw_index_of(a->object)].life, acquire) != a->ref->life) return -EIDRM;
    if (fw_now_ns(db) >= a->t_ns) return -ETIMEDOUT;
    if (db->header->kind == FW_REAL || db->has_clock || fw_lock_held(db, FW_LOCK_CLOCK)) a->dead_since_ns = 0;
    else if (!a->dead_since_ns) a->dead_since_ns = fw_platform_monotonic_ns();
    else if (fw_platform_monotonic_ns() - a->dead_since_ns > GRACE_NS) return -EHOSTDOWN;
    return 0;
}

int64_t fw_host_limit(const fw_db *db, int64_t t_ns) {
    return db->has_clock ? fw_platform_monotonic_ns() + (t_ns - fw_now_ns(db)) : INT64_MAX;
}

int64_t fw_wait_write_until(fw_db *db, fw_handle object, uint64_t after, int64_t t_ns, int64_t host_ns, int64_t *dead_since_ns) {
    awaited a = {object, after, t_ns, NULL, *dead_since_ns};
    int r = fw_ref_get(db, object, &a.ref);
    if (r == 0) r = fw_repeatable_only(db);
    if (r < 0) return r;
    fw_u32 *word = &db->object_wake[fw_index_of(object)];
    for (;;) {
        int64_t now = fw_platform_monotonic_ns(), left = t_ns - fw_now_ns(db), look = 1000000000;
        if (a.ref->flags & FW_NO_NOTIFY) look = a.ref->min_cycle_ns / 10 < 100000000 ? a.ref->min_cycle_ns / 10 + 1 : 100000000;
        else if (db->header->kind == FW_REAL && left < look) look = left;
        if (db->fd < 0 && (a.ref->flags & FW_NO_NOTIFY || db->header->kind != FW_REAL)) look = 0; /* nobody else can write or tick */
        if (look > host_ns - now) look = host_ns - now;
        int64_t w = fw_wait_for(db, word, written, &a, now + look);
        *dead_since_ns = a.dead_since_ns;
        if (w != -ETIMEDOUT || fw_now_ns(db) >= t_ns || db->fd < 0) return w;
        if (fw_platform_monotonic_ns() >= host_ns) return -EAGAIN;
    }
}

int64_t fw_wait_write(fw_db *db, fw_handle object, uint64_t after, int64_t t_ns) {
    int64_t dead_since_ns = 0, host_ns = fw_host_limit(db, t_ns);
    int64_t w = fw_wait_write_until(db, object, after, t_ns, host_ns, &dead_since_ns);
    return w == -EAGAIN ? -ETIMEDOUT : w;
}

static int64_t ticked(fw_db *db, const void *what) {
    uint64_t c = fw_cycle(db);
    return c > *(const uint64_t *)what ? (int64_t)c : 0;
}

int64_t fw_wait_cycle(fw_db *db, uint64_t after, int64_t timeout_ns) {
    return fw_wait_for(db, &db->wake->clock, ticked, &after, fw_platform_monotonic_ns() + timeout_ns);
}

static int64_t changed(fw_db *db, const void *what) { return fw_directory_version(db) != *(const uint64_t *)what; }

int fw_wait_directory(fw_db *db, uint64_t seen, int64_t timeout_ns) {
    int64_t r = fw_wait_for(db, &db->wake->directory, changed, &seen, fw_platform_monotonic_ns() + timeout_ns);
    return r < 0 ? (int)r : 0;
}
