/* objects.c - components, schemas and objects: the directory, and the public read, write and tick around protocol.h. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <unistd.h>

#include "fw_layout.h"

static uint64_t round_up(uint64_t n, uint64_t unit) { return (n + unit - 1) / unit * unit; }

/* Tells whoever waits on the word; costs a fence and a load when nobody does. */
void fw_notify(fw_db *db, fw_u32 *word) {
    if (!db->can_wake) return;
    FW_FENCE(seq_cst); /* with announce */
    uint32_t seen = FW_LOAD(*word, relaxed);
    if (!(seen & 1)) return;
    FW_STORE(*word, (seen + 2) & ~1u, relaxed);
    fw_platform_wake(word);
}

/* Says that somebody waits; the condition is looked at again after this and before sleeping. A waiter that is killed
 * leaves a bit that the next notify clears. */
static uint32_t announce(fw_u32 *word) { return atomic_fetch_or_explicit(word, 1, memory_order_seq_cst) | 1; }

/* Sleeps until notified, at most until the deadline; -ETIMEDOUT when it has passed. Interrupted calls return -EINTR. */
static int sleep_on(fw_db *db, fw_u32 *word, uint32_t seen, int64_t deadline_ns) {
    int64_t left = deadline_ns - fw_platform_monotonic_ns();
    if (left <= 0) return -ETIMEDOUT;
    if (!db->can_wake) { usleep(1000); return 0; } /* a store of somebody else: poll */
    int64_t slice = left < 100000000 ? left : 100000000; /* a notifier that was killed before it woke us costs 100 ms */
    int r = fw_platform_wait(word, seen, slice);
    return r == -EINTR ? r : 0;
}

static int directory_open(fw_db *db) {
    int r = 0;
    for (int i = 0; i < 20000; i++) { /* the holder needs microseconds; the kernel frees it when it dies */
        r = fw_lock(db, FW_LOCK_DIRECTORY, F_WRLCK);
        if (r != -EBUSY) break;
        usleep(50);
    }
    if (r == 0) r = fw_writable(db, db->map.directory, db->map.wake - db->map.directory, 1);
    if (r < 0) fw_lock(db, FW_LOCK_DIRECTORY, F_UNLCK);
    return r;
}

static void directory_close(fw_db *db) {
    fw_writable(db, db->map.directory, db->map.wake - db->map.directory, 0);
    fw_lock(db, FW_LOCK_DIRECTORY, F_UNLCK);
}

static int name_ok(const char *name) {
    size_t n = strnlen(name, FW_NAME_MAX);
    if (n == 0 || n == FW_NAME_MAX) return 0;
    for (size_t i = 0; i < n; i++)
        if ((unsigned char)name[i] <= ' ' || name[i] == '#' || name[i] == 127) return 0;
    return name[0] != '/' && name[n - 1] != '/';
}

/* -- components ------------------------------------------------------------------------------------------------- */

uint32_t fw_n_components(const fw_db *db) {
    uint32_t n = FW_LOAD(db->dir->n_components, acquire);
    return n <= db->header->max_components ? n : 0;
}

static int component_find(const fw_db *db, const char *name) {
    for (uint32_t i = 0; i < fw_n_components(db); i++)
        if (strncmp(db->components[i].name, name, FW_NAME_MAX) == 0) return (int)i;
    return -ENOENT;
}

int fw_join(fw_db *db, const char *name, int participant) {
    if (!name_ok(name) || strchr(name, '/')) return -EINVAL;
    int r = directory_open(db);
    if (r < 0) return r;
    int i = component_find(db, name);
    uint32_t n = fw_n_components(db);
    if (i >= 0 && db->owned[i]) r = -EBUSY;
    else if (i < 0 && n >= db->header->max_components) r = -ENOSPC;
    else r = fw_lock(db, FW_LOCK_COMPONENT + (i < 0 ? (int)n : i), F_WRLCK);
    if (r == 0) {
        fw_centry *entry = &db->components[i < 0 ? (int)n : i];
        strncpy(entry->name, name, FW_NAME_MAX - 1);
        entry->pid = getpid();
        entry->participant = participant != 0;
        if (i < 0) { i = (int)n; FW_STORE(db->dir->n_components, n + 1, release); }
        FW_STORE(db->done[i], FW_LOAD(db->clock->cycle, acquire), relaxed); /* owes nothing yet */
        db->owned[i] = 1;
        r = i;
    }
    directory_close(db);
    if (r < 0) return r;
    fw_ref_fill(db);
    for (uint32_t k = 0; k < db->n_refs; k++) { /* take over what a dead predecessor left */
        fw_ref *ref = &db->refs[k];
        if (ref->component != (uint32_t)r) continue;
        int m = fw_writable(db, (uint64_t)((uint8_t *)ref->ring - db->base),
                            sizeof(fw_ring) + (uint64_t)ref->stride * ref->n_slots, 1);
        if (m < 0) return m;
    }
    fw_notify(db, &db->wake->directory);
    return r;
}

int fw_leave(fw_db *db, uint32_t component) {
    if (component >= fw_n_components(db) || !db->owned[component]) return -EPERM;
    db->owned[component] = 0;
    for (uint32_t k = 0; k < db->n_refs; k++) /* what was begun is not committed after coming back */
        if (db->refs[k].component == component) db->refs[k].begun = 0;
    int r = fw_lock(db, FW_LOCK_COMPONENT + component, F_UNLCK);
    fw_notify(db, &db->wake->done);
    return r;
}

static int component_alive(const fw_db *db, uint32_t i) {
    return db->owned[i] || (db->fd >= 0 && fw_lock_held(db, FW_LOCK_COMPONENT + i));
}

int fw_component_get(const fw_db *db, uint32_t i, fw_component *out) {
    if (i >= fw_n_components(db)) return -ENOENT;
    const fw_centry *entry = &db->components[i];
    memcpy(out->name, entry->name, FW_NAME_MAX);
    out->name[FW_NAME_MAX - 1] = 0;
    out->pid = entry->pid;
    out->participant = entry->participant != 0;
    out->done = FW_LOAD(db->done[i], acquire);
    out->alive = component_alive(db, i);
    return 0;
}

/* -- schemas: {u32 length, text} one after the other ---------------------------------------------------------- */

int fw_schema_get(const fw_db *db, uint32_t schema, const char **text, uint32_t *n) {
    uint32_t used = FW_LOAD(db->dir->schema_used, acquire);
    if (used > db->header->schema_bytes) return -EPROTO;
    uint64_t at = 0;
    for (uint32_t i = 0; at + 4 <= used; i++) {
        uint32_t length;
        memcpy(&length, db->schemas + at, 4);
        if (at + 4 + (uint64_t)length > used) return -EPROTO;
        if (i == schema) { *text = (const char *)db->schemas + at + 4; *n = length; return 0; }
        at += round_up(4 + (uint64_t)length, 8);
    }
    return -ENOENT;
}

int fw_schema_add(fw_db *db, const char *text, uint32_t n) {
    int r = directory_open(db);
    if (r < 0) return r;
    const char *known;
    uint32_t length, i = 0;
    while ((r = fw_schema_get(db, i, &known, &length)) == 0 && !(length == n && memcmp(known, text, n) == 0)) i++;
    if (r == -ENOENT) {
        uint32_t used = FW_LOAD(db->dir->schema_used, relaxed);
        uint64_t end = used + round_up(4 + (uint64_t)n, 8);
        if (end > db->header->schema_bytes) r = -ENOSPC;
        else {
            memcpy(db->schemas + used, &n, 4);
            memcpy(db->schemas + used + 4, text, n);
            FW_STORE(db->dir->schema_used, (uint32_t)end, release);
            r = 0;
        }
    }
    directory_close(db);
    return r < 0 ? r : (int)i;
}

/* -- objects --------------------------------------------------------------------------------------------------- */

uint32_t fw_n_objects(const fw_db *db) {
    uint32_t n = FW_LOAD(db->dir->n_objects, acquire);
    return n <= db->header->max_objects ? n : 0;
}

static uint64_t ring_bytes(const fw_oentry *e) { return sizeof(fw_ring) + (uint64_t)e->stride * e->spec.n_slots; }
static uint64_t cuts_bytes(const fw_oentry *e) { return round_up(sizeof(fw_cuts) + sizeof(fw_cut) * (uint64_t)e->spec.n_slots, 64); }
static uint32_t payload_off(uint32_t n_causes) { return (uint32_t)(sizeof(fw_slot) + sizeof(fw_cause) * n_causes); }

static int entry_ok(const fw_db *db, const fw_oentry *e) {
    return e->spec.n_slots >= 4 && e->spec.n_slots <= 1u << 24 && e->spec.every >= 1 && e->spec.phase < e->spec.every &&
           e->spec.n_causes <= FW_CAUSES_MAX && e->spec.component < db->header->max_components &&
           e->stride % 64 == 0 && e->stride >= (uint64_t)payload_off(e->spec.n_causes) + e->spec.size &&
           e->ring_off % 64 == 0 && e->ring_off >= db->map.heap && ring_bytes(e) <= db->map.size - db->map.heap &&
           e->ring_off + ring_bytes(e) <= db->map.size && e->cuts_off % 64 == 0 && e->cuts_off >= db->map.heap &&
           e->cuts_off <= db->map.size && cuts_bytes(e) <= db->map.size - e->cuts_off;
}

/* Copies what an entry says into this process, once, after checking every offset. */
int fw_ref_fill(fw_db *db) {
    uint32_t n = fw_n_objects(db);
    for (; db->n_refs < n; db->n_refs++) {
        fw_oentry e = db->objects[db->n_refs];
        if (!entry_ok(db, &e)) return -EPROTO;
        db->refs[db->n_refs] = (fw_ref){
            .ring = (fw_ring *)(db->base + e.ring_off), .cuts = (fw_cuts *)(db->base + e.cuts_off),
            .slots = db->base + e.ring_off + sizeof(fw_ring), .stride = e.stride, .n_slots = e.spec.n_slots,
            .size = e.spec.size, .n_causes = e.spec.n_causes, .every = e.spec.every, .phase = e.spec.phase,
            .component = e.spec.component};
    }
    return 0;
}

static int ref_get(const fw_db *db, uint32_t object, fw_ref **out) {
    if (object >= db->n_refs) {
        int r = fw_ref_fill((fw_db *)(uintptr_t)db); /* the memory of this process only */
        if (r < 0) return r;
        if (object >= db->n_refs) return -ENOENT;
    }
    *out = &db->refs[object];
    return 0;
}

static fw_slot *slot_of(const fw_ref *ref, uint64_t w) { return (fw_slot *)(ref->slots + (uint64_t)ref->stride * (w % ref->n_slots)); }
static uint8_t *payload_of(const fw_ref *ref, fw_slot *slot) { return (uint8_t *)slot + payload_off(ref->n_causes); }

int fw_find(const fw_db *db, const char *name) {
    uint32_t n = fw_n_objects(db);
    for (uint32_t i = 0; i < n; i++)
        if (strncmp(db->objects[i].spec.name, name, FW_NAME_MAX) == 0) return (int)i;
    return -ENOENT;
}

int fw_object_get(const fw_db *db, uint32_t object, fw_object *out) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    out->spec = db->objects[object].spec;
    out->spec.name[FW_NAME_MAX - 1] = 0;
    out->oid = db->objects[object].oid;
    out->head = FW_LOAD(ref->ring->head, acquire);
    out->refused = FW_LOAD(ref->ring->refused, relaxed);
    return 0;
}

/* Finds room, fills the next entry, and publishes it by the count alone: killed anywhere before that, nothing has
 * happened but a bit of heap that is given out no more. */
static int insert_locked(fw_db *db, const fw_spec *spec) {
    uint32_t n = fw_n_objects(db);
    if (fw_find(db, spec->name) >= 0) return -EEXIST;
    if (n >= db->header->max_objects) return -ENOSPC;
    fw_oentry e = {.spec = *spec, .oid = FW_LOAD(db->dir->next_oid, relaxed)};
    uint64_t unit = db->fd < 0 ? 64 : FW_PAGE, stride = round_up((uint64_t)payload_off(spec->n_causes) + spec->size, 64);
    if (stride > UINT32_MAX) return -ENOSPC;
    e.stride = (uint32_t)stride;
    uint64_t low = FW_LOAD(db->dir->heap_low, relaxed), high = FW_LOAD(db->dir->heap_high, relaxed);
    e.ring_off = round_up(low, unit);
    uint64_t new_low = e.ring_off + round_up(ring_bytes(&e), unit);
    if (cuts_bytes(&e) > high || (e.cuts_off = high - cuts_bytes(&e)) / unit * unit < new_low) return -ENOSPC;
    FW_STORE(db->dir->heap_low, new_low, relaxed);
    FW_STORE(db->dir->heap_high, e.cuts_off, relaxed);
    FW_STORE(db->dir->next_oid, e.oid + 1, relaxed);
    memcpy(&db->objects[n], &e, sizeof e);
    FW_STORE(db->dir->n_objects, n + 1, release);
    return (int)n;
}

int fw_insert(fw_db *db, const fw_spec *spec) {
    if (!name_ok(spec->name) || spec->n_slots < 4 || spec->n_slots > 1u << 24 || spec->every < 1 ||
        spec->phase >= spec->every || spec->n_causes > FW_CAUSES_MAX || spec->size > 1u << 30) return -EINVAL;
    if (spec->component >= fw_n_components(db) || !db->owned[spec->component]) return -EPERM;
    int r = directory_open(db);
    if (r < 0) return r;
    int index = insert_locked(db, spec);
    directory_close(db);
    if (index < 0) return index;
    if ((r = fw_ref_fill(db)) < 0) return r;
    const fw_oentry *e = &db->objects[index];
    if ((r = fw_writable(db, e->ring_off, ring_bytes(e), 1)) < 0) return r;
    if (db->fd < 0) { /* the heap may have been used before an image was restored; a file's is zero from the start */
        memset(db->base + e->ring_off, 0, ring_bytes(e));
        memset(db->base + e->cuts_off, 0, cuts_bytes(e));
    }
    fw_notify(db, &db->wake->directory);
    return index;
}

/* -- writing --------------------------------------------------------------------------------------------------- */

int fw_write_begin(fw_db *db, uint32_t object, void **slot_out) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    if (!db->owned[ref->component]) return -EPERM;
    uint64_t w = FW_LOAD(ref->ring->head, relaxed) + 1;
    if (!fw_may_write(ref->ring, ref->cuts, db->clock, w, ref->n_slots)) {
        FW_STORE(ref->ring->refused, FW_LOAD(ref->ring->refused, relaxed) + 1, relaxed);
        return -EBUSY;
    }
    fw_slot *slot = slot_of(ref, w);
    fw_slot_open(slot, w);
    ref->begun = w;
    *slot_out = payload_of(ref, slot);
    return 0;
}

int64_t fw_write_commit(fw_db *db, uint32_t object, uint32_t n, int64_t t_data_ns, const fw_cause *causes, uint32_t n_causes) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    if (!ref->begun || !db->owned[ref->component]) return -EPERM;
    if (n > ref->size) return -EMSGSIZE;
    if (n_causes > ref->n_causes) return -EINVAL;
    uint64_t w = ref->begun;
    fw_slot *slot = slot_of(ref, w);
    if (t_data_ns < ref->ring->t_data_ns) t_data_ns = ref->ring->t_data_ns;
    ref->ring->t_data_ns = t_data_ns;
    FW_STORE(slot->t_commit_ns, (uint64_t)fw_now_ns(db), relaxed);
    FW_STORE(slot->t_data_ns, (uint64_t)t_data_ns, relaxed);
    FW_STORE(slot->size_causes, n | (uint64_t)n_causes << 32, relaxed);
    if (n_causes) fw_copy_in(slot + 1, causes, (uint32_t)sizeof(fw_cause) * n_causes);
    fw_slot_publish(ref->ring, slot, db->clock, w);
    ref->begun = 0;
    fw_notify(db, &db->object_wake[object]);
    return (int64_t)w;
}

int64_t fw_write(fw_db *db, uint32_t object, const void *data, uint32_t n, int64_t t_data_ns, const fw_cause *causes,
                 uint32_t n_causes) {
    fw_ref *ref;
    void *slot;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    if (n > ref->size) return -EMSGSIZE;
    if (n_causes > ref->n_causes) return -EINVAL;
    if ((r = fw_write_begin(db, object, &slot)) < 0) return r;
    fw_copy_in(slot, data, n);
    return fw_write_commit(db, object, n, t_data_ns, causes, n_causes);
}

/* -- reading --------------------------------------------------------------------------------------------------- */

int64_t fw_newest(const fw_db *db, uint32_t object) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    return r < 0 ? r : (int64_t)FW_LOAD(ref->ring->head, acquire);
}

int64_t fw_visible(const fw_db *db, uint32_t object, uint64_t cycle) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    if (cycle > fw_cycle(db)) return -EDOM;
    return fw_cut_find(ref->cuts, ref->n_slots, cycle);
}

int64_t fw_changed(const fw_db *db, uint32_t object) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    uint64_t k = FW_LOAD(ref->cuts->head, acquire);
    if (!k || FW_LOAD(ref->cuts->log[(k - 1) % ref->n_slots].cycle, relaxed) != fw_cycle(db)) return 0;
    return (int64_t)FW_LOAD(ref->cuts->log[(k - 1) % ref->n_slots].write, relaxed);
}

static void info_get(const fw_ref *ref, const fw_slot *slot, uint64_t w, fw_info *info) {
    uint64_t size_causes = FW_LOAD(((fw_slot *)(uintptr_t)slot)->size_causes, relaxed);
    uint32_t n_causes = (uint32_t)(size_causes >> 32);
    info->write = w;
    info->t_commit_ns = (int64_t)FW_LOAD(((fw_slot *)(uintptr_t)slot)->t_commit_ns, relaxed);
    info->t_data_ns = (int64_t)FW_LOAD(((fw_slot *)(uintptr_t)slot)->t_data_ns, relaxed);
    info->size = (uint32_t)size_causes <= ref->size ? (uint32_t)size_causes : ref->size; /* may be torn: checked later */
    info->n_causes = n_causes <= ref->n_causes ? n_causes : ref->n_causes;
    if (info->n_causes) fw_copy_out(info->causes, slot + 1, (uint32_t)sizeof(fw_cause) * info->n_causes);
}

int fw_read(const fw_db *db, uint32_t object, uint64_t w, void *buffer, uint32_t capacity, fw_info *info) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    if (w == 0) return -EAGAIN;
    fw_slot *slot = slot_of(ref, w);
    if ((r = fw_slot_check(slot, w)) < 0) return r;
    info_get(ref, slot, w, info);
    if (info->size > capacity) return (r = fw_slot_still(slot, w)) < 0 ? r : -EMSGSIZE;
    fw_copy_out(buffer, payload_of(ref, slot), info->size);
    return fw_slot_still(slot, w);
}

int fw_peek(const fw_db *db, uint32_t object, uint64_t w, const void **data, fw_info *info) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    if (w == 0) return -EAGAIN;
    fw_slot *slot = slot_of(ref, w);
    if ((r = fw_slot_check(slot, w)) < 0) return r;
    info_get(ref, slot, w, info);
    *data = payload_of(ref, slot);
    return fw_slot_still(slot, w);
}

int fw_check(const fw_db *db, uint32_t object, uint64_t w) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    return r < 0 ? r : fw_slot_still(slot_of(ref, w), w);
}

/* Commit stamps grow with write numbers, so this is a binary search. Not repeatable while the writer runs. */
int64_t fw_as_of(const fw_db *db, uint32_t object, int64_t t_ns) {
    fw_ref *ref;
    int r = ref_get(db, object, &ref);
    if (r < 0) return r;
    uint64_t head = FW_LOAD(ref->ring->head, acquire);
    uint64_t oldest = head >= ref->n_slots ? head - ref->n_slots + 2 : 1; /* the slot of the write under construction is gone */
    uint64_t lo = oldest, hi = head + 1;
    while (lo < hi) {
        uint64_t mid = lo + (hi - lo) / 2;
        fw_slot *slot = slot_of(ref, mid);
        int64_t t = (int64_t)FW_LOAD(slot->t_commit_ns, relaxed);
        if (fw_slot_still(slot, mid) == 0 && t > t_ns) hi = mid;
        else lo = mid + 1; /* an overwritten slot is older than all that are left */
    }
    if (lo > oldest) return (int64_t)lo - 1;
    return oldest > 1 ? -ESTALE : -EAGAIN;
}

/* -- clock ------------------------------------------------------------------------------------------------------ */

uint64_t fw_cycle(const fw_db *db) { return FW_LOAD(db->clock->cycle, acquire); }
int64_t fw_now_ns(const fw_db *db) { return db->header->t0_ns + (int64_t)fw_cycle(db) * db->header->tick_ns; }

int fw_clock_take(fw_db *db) {
    int r = fw_lock(db, FW_LOCK_CLOCK, F_WRLCK);
    if (r == 0) r = fw_writable(db, db->map.clock, FW_PAGE, 1);
    if (r == 0) db->has_clock = 1;
    return r;
}

int64_t fw_tick(fw_db *db) {
    if (!db->has_clock) return -EPERM;
    int r = fw_ref_fill(db);
    if (r < 0) return r;
    uint64_t cuts_low = FW_LOAD(db->dir->heap_high, acquire) / FW_PAGE * FW_PAGE;
    if (db->fd >= 0 && cuts_low < db->cuts_mapped) { /* cut logs of new objects */
        if ((r = fw_writable(db, cuts_low, db->map.size - cuts_low, 1)) < 0) return r;
        db->cuts_mapped = cuts_low;
    }
    uint64_t c = FW_LOAD(db->clock->cycle, relaxed) + 1;
    fw_tick_begin(db->clock, c);
    for (uint32_t i = 0; i < db->n_refs; i++) {
        fw_ref *ref = &db->refs[i];
        if (ref->every == 1 || c % ref->every == ref->phase) fw_tick_object(ref->ring, ref->cuts, ref->n_slots, c);
    }
    fw_tick_end(db->clock, c);
    fw_notify(db, &db->wake->clock);
    return (int64_t)c;
}

int64_t fw_wait_cycle(fw_db *db, uint64_t after, int64_t timeout_ns) {
    int64_t deadline = fw_platform_monotonic_ns() + timeout_ns;
    for (;;) {
        uint64_t c = fw_cycle(db);
        if (c > after) return (int64_t)c;
        uint32_t seen = db->can_wake ? announce(&db->wake->clock) : 0;
        if ((c = fw_cycle(db)) > after) return (int64_t)c;
        int r = sleep_on(db, &db->wake->clock, seen, deadline);
        if (r < 0) return r;
    }
}

int fw_done(fw_db *db, uint32_t component, uint64_t cycle) {
    if (component >= fw_n_components(db) || !db->owned[component]) return -EPERM;
    FW_STORE(db->done[component], cycle, release);
    fw_notify(db, &db->wake->done);
    return 0;
}

/* The index of a living participant that is not done with the cycle, -1 when there is none. */
static int who_works(const fw_db *db, uint64_t cycle) {
    for (uint32_t i = 0; i < fw_n_components(db); i++)
        if (db->components[i].participant && FW_LOAD(db->done[i], acquire) < cycle && component_alive(db, i)) return (int)i;
    return -1;
}

int fw_wait_done(fw_db *db, uint64_t cycle, int64_t timeout_ns) {
    int64_t deadline = fw_platform_monotonic_ns() + timeout_ns;
    for (;;) {
        if (who_works(db, cycle) < 0) return 0;
        uint32_t seen = db->can_wake ? announce(&db->wake->done) : 0;
        if (who_works(db, cycle) < 0) return 0;
        int r = sleep_on(db, &db->wake->done, seen, deadline);
        if (r < 0) return r;
    }
}

int fw_wait_object(fw_db *db, uint32_t n_objects, int64_t timeout_ns) {
    int64_t deadline = fw_platform_monotonic_ns() + timeout_ns;
    for (;;) {
        if (fw_n_objects(db) > n_objects) return 0;
        uint32_t seen = db->can_wake ? announce(&db->wake->directory) : 0;
        if (fw_n_objects(db) > n_objects) return 0;
        int r = sleep_on(db, &db->wake->directory, seen, deadline);
        if (r < 0) return r;
    }
}
