/* objects.c - writing and reading: the data path around protocol.h. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <sched.h>

#include "fw_layout.h"

static uint32_t payload_off(uint32_t n_causes) { return (uint32_t)(sizeof(fw_slot) + sizeof(fw_cause) * n_causes); }
static fw_slot *slot_of(const fw_ref *ref, uint64_t w) { return (fw_slot *)(ref->slots + (uint64_t)ref->stride * (w % ref->n_slots)); }
static uint8_t *payload_of(const fw_ref *ref, fw_slot *slot) { return (uint8_t *)slot + payload_off(ref->n_causes); }
static fw_life *life_of(const fw_db *db, fw_handle object) { return &db->life[fw_index_of(object)]; }

/* -- writing -------------------------------------------------------------------------------------------------------- */

/* Whether this process may write the object now; the next write number. */
static int64_t may_write(fw_db *db, fw_handle object, fw_ref *ref) {
    if (FW_LOAD(life_of(db, object)->deleted, relaxed)) {
        if (!(ref->flags & FW_PUBLIC_WRITE) && db->self[ref->component].owned && !FW_LOAD(ref->ring->released, relaxed)) {
            fw_ring_writable(db, ref, 1);
            FW_STORE(ref->ring->released, 1, release); /* we shall not touch it again: its storage may go */
            fw_ring_writable(db, ref, 0);
        }
        return -EIDRM;
    }
    uint64_t w = FW_LOAD(ref->ring->head, relaxed) + 1;
    if (w >= INT64_MAX) return -EPROTO;
    if (fw_may_write(ref->ring, ref->cuts, &db->clock->edge, w, ref->n_slots) &&
        !(ref->flags & FW_CYCLE_WATCH && w > 1 &&
          fw_now_ns(db) - (int64_t)FW_LOAD(ref->ring->t_commit_ns, relaxed) < ref->min_cycle_ns)) return (int64_t)w;
    FW_STORE(ref->ring->refused, FW_LOAD(ref->ring->refused, relaxed) + 1, relaxed);
    return -EBUSY;
}

static fw_slot *open_slot(fw_ref *ref, uint64_t w) {
    fw_slot *slot = slot_of(ref, w);
    fw_slot_open(slot, w);
    return slot;
}

static void publish(fw_db *db, fw_handle object, fw_ref *ref, uint64_t w, uint64_t size_causes, int64_t t_data_ns,
                    const fw_cause *causes, uint32_t n_causes) {
    fw_slot *slot = slot_of(ref, w);
    int64_t now = fw_now_ns(db);
    FW_STORE(ref->ring->t_data_ns, (uint64_t)t_data_ns, relaxed);
    FW_STORE(ref->ring->t_commit_ns, (uint64_t)now, relaxed);
    FW_STORE(slot->t_commit_ns, (uint64_t)now, relaxed);
    FW_STORE(slot->t_data_ns, (uint64_t)t_data_ns, relaxed);
    FW_STORE(slot->size_causes, size_causes, relaxed);
    if (n_causes) fw_copy_in(slot + 1, causes, (uint32_t)sizeof(fw_cause) * n_causes);
    fw_slot_publish(ref->ring, slot, &db->clock->edge, w);
    if (!(ref->flags & FW_NO_NOTIFY)) fw_tell(db, &db->object_wake[fw_index_of(object)]);
}

void fw_restamp(fw_ref *ref) {
    uint64_t head = FW_LOAD(ref->ring->head, relaxed);
    fw_slot *slot = slot_of(ref, head);
    FW_STORE(ref->ring->t_data_ns, head ? FW_LOAD(slot->t_data_ns, relaxed) : 0, relaxed);
    FW_STORE(ref->ring->t_commit_ns, head ? FW_LOAD(slot->t_commit_ns, relaxed) : 0, relaxed);
}

static int fits(fw_ref *ref, uint32_t n, int64_t t_data_ns, uint32_t n_causes) {
    if (n > ref->size) return -EMSGSIZE;
    if (n_causes > ref->n_causes) return -EINVAL;
    return FW_LOAD(ref->ring->head, relaxed) && t_data_ns < (int64_t)FW_LOAD(ref->ring->t_data_ns, relaxed) ? -ERANGE : 0;
}

int64_t fw_not_before(fw_db *db, fw_handle object, int64_t t_data_ns) {
    fw_ref *ref;
    int r = fw_ref_get(db, object, &ref);
    if (r < 0) return r;
    int64_t newest = (int64_t)FW_LOAD(ref->ring->t_data_ns, relaxed);
    return FW_LOAD(ref->ring->head, relaxed) && newest > t_data_ns ? newest : t_data_ns;
}

int fw_write_begin(fw_db *db, fw_handle object, void **slot) {
    fw_ref *ref;
    int r = fw_ref_get(db, object, &ref);
    if (r < 0) return r;
    if (!db->self[ref->component].owned || ref->flags & FW_PUBLIC_WRITE) return -EPERM;
    int64_t w = may_write(db, object, ref);
    if (w < 0) return (int)w;
    ref->begun = (uint64_t)w;
    *slot = payload_of(ref, open_slot(ref, (uint64_t)w));
    return 0;
}

int64_t fw_write_commit(fw_db *db, fw_handle object, uint32_t n, int64_t t_data_ns, const fw_cause *causes, uint32_t n_causes) {
    fw_ref *ref;
    int r = fw_ref_get(db, object, &ref);
    if (r < 0) return r;
    if (!ref->begun || !db->self[ref->component].owned) return -EPERM;
    if ((r = fits(ref, n, t_data_ns, n_causes)) < 0) return r;
    uint64_t w = ref->begun;
    ref->begun = 0;
    publish(db, object, ref, w, n | (uint64_t)n_causes << 32 | (uint64_t)ref->component << 40, t_data_ns, causes, n_causes);
    return (int64_t)w;
}

static int64_t write_now(fw_db *db, fw_handle object, fw_ref *ref, const void *data, uint32_t n, int64_t t_data_ns,
                         const fw_cause *causes, uint32_t n_causes, uint32_t writer) {
    int r = fits(ref, n, t_data_ns, n_causes);
    if (r < 0) return r;
    int64_t w = may_write(db, object, ref);
    if (w < 0) return w;
    fw_copy_in(payload_of(ref, open_slot(ref, (uint64_t)w)), data, n);
    ref->begun = 0;
    publish(db, object, ref, (uint64_t)w, n | (uint64_t)n_causes << 32 | (uint64_t)writer << 40, t_data_ns, causes, n_causes);
    return w;
}

/* Anybody writes a public object, one at a time: the kernel gives the lock back when its holder dies. */
static int64_t write_public(fw_db *db, fw_handle object, fw_ref *ref, const void *data, uint32_t n, int64_t t_data_ns,
                            const fw_cause *causes, uint32_t n_causes) {
    int64_t byte = FW_LOCK_OBJECT + (int64_t)fw_index_of(object);
    int r = -EBUSY;
    for (int i = 0; i < 2000 && (r = fw_lock(db, byte, F_WRLCK)) == -EBUSY; i++) { /* 100 ms: its holder may be stopped */
        if (i < 20) sched_yield();
        else fw_platform_sleep_until(fw_platform_monotonic_ns() + 50000);
    }
    if (r < 0) return r;
    if (!ref->public_mapped) { fw_ring_writable(db, ref, 1); ref->public_mapped = 1; }
    fw_restamp(ref);
    uint32_t writer = ref->component;
    for (uint32_t i = 0; !db->self[writer].owned && i < fw_n_components(db); i++)
        if (db->self[i].owned) { writer = i; break; }
    int64_t w = fw_life_still(&life_of(db, object)->life, ref->life);
    if (w == 0) w = write_now(db, object, ref, data, n, t_data_ns, causes, n_causes, writer);
    fw_lock(db, byte, F_UNLCK);
    return w;
}

int64_t fw_write(fw_db *db, fw_handle object, const void *data, uint32_t n, int64_t t_data_ns, const fw_cause *causes,
                 uint32_t n_causes) {
    fw_ref *ref;
    int r = fw_ref_get(db, object, &ref);
    if (r < 0) return r;
    if (ref->flags & FW_PUBLIC_WRITE) return write_public(db, object, ref, data, n, t_data_ns, causes, n_causes);
    if (!db->self[ref->component].owned) return -EPERM;
    return write_now(db, object, ref, data, n, t_data_ns, causes, n_causes, ref->component);
}

/* -- which write ------------------------------------------------------------------------------------------------------ */

/* Whether the history of a deleted object had its time, be its storage given to others or not. */
static int is_over(const fw_db *db, fw_handle object, const fw_ref *ref) {
    return ref->flags & FW_IMMEDIATE_DELETE || fw_now_ns(db) - db->death[fw_index_of(object)].t_ns >= ref->t_history_ns;
}

static int readable(const fw_db *db, fw_handle object, fw_ref **ref) {
    int r = fw_ref_get(db, object, ref);
    if (r < 0) return r;
    if (FW_LOAD(life_of(db, object)->deleted, relaxed) && is_over(db, object, *ref)) return -EIDRM;
    return (*ref)->flags & FW_READ_DENY && !db->self[(*ref)->component].owned ? -EACCES : 0;
}

/* The components of a deterministic store read cuts: everything else depends on who is faster. */
int fw_repeatable_only(const fw_db *db) { return db->header->deterministic && db->n_owned ? -EOPNOTSUPP : 0; }

/* The write, unless its storage is gone or it is too old to be shown. */
static int64_t show(const fw_db *db, fw_handle object, fw_ref *ref, int64_t w, int64_t now_ns) {
    if (ref->flags & FW_WITHHOLD_STALE && w > 0) {
        int64_t t = (int64_t)FW_LOAD(slot_of(ref, (uint64_t)w)->t_commit_ns, relaxed);
        if (fw_slot_still(slot_of(ref, (uint64_t)w), (uint64_t)w) == 0 && now_ns - t > ref->max_age_ns) return -ETIME;
    }
    FW_FENCE(acquire);
    int r = fw_life_still(&life_of(db, object)->life, ref->life);
    return r < 0 ? r : w;
}

int64_t fw_visible(const fw_db *db, fw_handle object, uint64_t cycle) {
    fw_ref *ref;
    int r = readable(db, object, &ref);
    if (r < 0) return r;
    if (cycle > fw_cycle(db)) return -EDOM;
    uint64_t deleted = FW_LOAD(life_of(db, object)->deleted, relaxed);
    if (deleted && cycle >= deleted) return -EIDRM;
    return show(db, object, ref, fw_cut_find(ref->cuts, ref->n_slots, cycle),
                ref->flags & FW_WITHHOLD_STALE ? fw_t0_ns(db) + (int64_t)cycle * db->header->tick_ns : 0);
}

int64_t fw_newest(const fw_db *db, fw_handle object) {
    fw_ref *ref;
    int r = readable(db, object, &ref);
    if (r == 0) r = fw_repeatable_only(db);
    if (r < 0) return r;
    if (FW_LOAD(life_of(db, object)->deleted, relaxed)) return -EIDRM;
    return show(db, object, ref, (int64_t)FW_LOAD(ref->ring->head, acquire), ref->flags & FW_WITHHOLD_STALE ? fw_now_ns(db) : 0);
}

int64_t fw_changed(const fw_db *db, fw_handle object) {
    fw_ref *ref;
    int r = readable(db, object, &ref);
    if (r < 0) return r;
    uint64_t k = FW_LOAD(ref->cuts->head, acquire);
    if (!k || FW_LOAD(fw_log(ref->cuts)[(k - 1) % ref->n_slots].cycle, relaxed) != fw_cycle(db)) return 0;
    return (int64_t)FW_LOAD(fw_log(ref->cuts)[(k - 1) % ref->n_slots].write, relaxed);
}

static uint64_t oldest_of(const fw_ref *ref, uint64_t head) { /* the slot of the write under construction is gone */
    return head >= ref->n_slots ? head - ref->n_slots + 2 : 1;
}

/* Stamps grow with write numbers, so this is a binary search. */
static int64_t search(const fw_db *db, fw_handle object, int64_t t_ns, int by_data) {
    fw_ref *ref;
    int r = readable(db, object, &ref);
    if (r == 0) r = fw_repeatable_only(db);
    if (r < 0) return r;
    if (FW_LOAD(life_of(db, object)->deleted, acquire) && t_ns >= db->death[fw_index_of(object)].t_ns) return -EIDRM;
    uint64_t head = FW_LOAD(ref->ring->head, acquire), oldest = oldest_of(ref, head), lo = oldest, hi = head + 1;
    while (lo < hi) {
        uint64_t mid = lo + (hi - lo) / 2;
        fw_slot *slot = slot_of(ref, mid);
        int64_t t = (int64_t)(by_data ? FW_LOAD(slot->t_data_ns, relaxed) : FW_LOAD(slot->t_commit_ns, relaxed));
        if (fw_slot_still(slot, mid) == 0 && t > t_ns) hi = mid;
        else lo = mid + 1; /* an overwritten slot is older than all that are left */
    }
    if (lo > oldest) return show(db, object, ref, (int64_t)lo - 1, t_ns);
    return oldest > 1 ? -ESTALE : -EAGAIN;
}

int64_t fw_as_of(const fw_db *db, fw_handle object, int64_t t_ns) { return search(db, object, t_ns, 0); }
int64_t fw_as_of_data(const fw_db *db, fw_handle object, int64_t t_ns) { return search(db, object, t_ns, 1); }

int64_t fw_next(const fw_db *db, fw_handle object, uint64_t after, uint64_t *lost) {
    fw_ref *ref;
    int r = readable(db, object, &ref);
    if (r == 0) r = fw_repeatable_only(db);
    if (r < 0) return r;
    uint64_t head = FW_LOAD(ref->ring->head, acquire), w = after + 1;
    if (head >= w && w < oldest_of(ref, head)) w = oldest_of(ref, head);
    if (head < w) return FW_LOAD(life_of(db, object)->deleted, relaxed) ? -EIDRM : -EAGAIN;
    *lost = w - after - 1;
    return show(db, object, ref, (int64_t)w, INT64_MIN / 2); /* however old */
}

/* -- what it says ----------------------------------------------------------------------------------------------------- */

static void info_get(const fw_ref *ref, fw_slot *slot, uint64_t w, fw_info *info) {
    uint64_t packed = FW_LOAD(slot->size_causes, relaxed);
    uint32_t size = (uint32_t)packed, n_causes = (uint32_t)(packed >> 32) & 0xff;
    info->write = w;
    info->t_commit_ns = (int64_t)FW_LOAD(slot->t_commit_ns, relaxed);
    info->t_data_ns = (int64_t)FW_LOAD(slot->t_data_ns, relaxed);
    info->size = size <= ref->size ? size : ref->size; /* may be torn: checked later */
    info->writer = (uint32_t)(packed >> 40);
    info->n_causes = n_causes <= ref->n_causes ? n_causes : ref->n_causes;
    if (info->n_causes) fw_copy_out(info->causes, slot + 1, (uint32_t)sizeof(fw_cause) * info->n_causes);
}

/* Behind the reading of a slot: was it that write, of that object, all the while? */
static int still(const fw_db *db, fw_handle object, const fw_ref *ref, fw_slot *slot, uint64_t w) {
    int r = fw_slot_still(slot, w), gone = fw_life_still(&life_of(db, object)->life, ref->life);
    return gone < 0 ? gone : r;
}

int fw_peek(const fw_db *db, fw_handle object, uint64_t w, const void **data, fw_info *info) {
    fw_ref *ref;
    int r = readable(db, object, &ref);
    if (r < 0) return r;
    if (w == 0) return -EAGAIN;
    fw_slot *slot = slot_of(ref, w);
    if ((r = fw_slot_check(slot, w)) < 0) return fw_life_still(&life_of(db, object)->life, ref->life) < 0 ? -EIDRM : r;
    info_get(ref, slot, w, info);
    *data = payload_of(ref, slot);
    return still(db, object, ref, slot, w);
}

int fw_read(const fw_db *db, fw_handle object, uint64_t w, void *buffer, uint32_t capacity, fw_info *info) {
    const void *data;
    int r = fw_peek(db, object, w, &data, info);
    if (r < 0) return r;
    if (info->size > capacity) return -EMSGSIZE;
    fw_copy_out(buffer, data, info->size);
    return fw_check(db, object, w);
}

int fw_check(const fw_db *db, fw_handle object, uint64_t w) {
    fw_ref *ref;
    int r = fw_ref_get(db, object, &ref);
    return r < 0 ? r : still(db, object, ref, slot_of(ref, w), w);
}
