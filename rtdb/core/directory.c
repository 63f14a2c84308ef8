/* directory.c - which objects there are: changes as intents, the heap, and what this process remembers of each object.
 * All that changes the directory happens under the directory lock, away from the data path. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <sched.h>

#include "fw_layout.h"

#ifdef FW_TEST_KILLS /* a build for the tests dies at the step that they name */
void fw_test_step(void);
#define STEP() fw_test_step()
#else
#define STEP() ((void)0)
#endif

/* -- the heap: a bit map of granules ------------------------------------------------------------------------------ */

static uint64_t granule_of(const fw_db *db, uint64_t off) { return (off - db->map.heap) / db->map.granule; }

static int is_used(const fw_db *db, uint64_t g) { return (int)(FW_LOAD(db->dir->used[g / 64], relaxed) >> (g % 64) & 1); }

/* The first granule from g on, before end, that is used (or not). */
static uint64_t next_granule(const fw_db *db, uint64_t g, uint64_t end, int used) {
    while (g < end) {
        uint64_t word = FW_LOAD(db->dir->used[g / 64], relaxed);
        word = (used ? word : ~word) >> (g % 64);
        if (word) { g += (uint64_t)__builtin_ctzll(word); break; }
        g = (g / 64 + 1) * 64;
    }
    return g < end ? g : end;
}

/* Marks the granules of [off, off+n): doing it again does no harm. */
static void mark(fw_db *db, uint64_t off, uint64_t n, int used) {
    for (uint64_t g = granule_of(db, off), end = granule_of(db, off + n + db->map.granule - 1); g < end; g++) {
        uint64_t word = FW_LOAD(db->dir->used[g / 64], relaxed), bit = 1ull << (g % 64);
        FW_STORE(db->dir->used[g / 64], used ? word | bit : word & ~bit, relaxed);
    }
}

/* A free run of n bytes in [low, high) at a multiple of unit, 0 if there is none. */
static uint64_t free_run(const fw_db *db, uint64_t low, uint64_t high, uint64_t n, uint64_t unit) {
    for (uint64_t off = fw_round_up(low, unit); off + n <= high;) {
        uint64_t end = granule_of(db, off + n + db->map.granule - 1);
        uint64_t hit = next_granule(db, granule_of(db, off), end, 1);
        if (hit == end) return off;
        off = fw_round_up(db->map.heap + next_granule(db, hit, granule_of(db, high), 0) * db->map.granule, unit);
    }
    return 0;
}

static uint64_t heap_unit(const fw_db *db) { /* of rings, and what separates them from the cut logs */
    return db->fd >= 0 && db->map.granule < FW_PAGE ? FW_PAGE : db->map.granule;
}

/* Finds room for the ring, below what was ever a cut log, and for the cut log, above what was ever a ring. Rings begin at
 * different lines of their pages: 1,000 heads at page boundaries would all compete for the same few lines of the cache. */
static int place(const fw_db *db, fw_oentry *e, uint32_t i, uint64_t ring_bytes, uint64_t cuts_bytes) {
    uint64_t colour = db->fd >= 0 ? i % 32 * 64 : 0;
    uint64_t low = FW_LOAD(db->dir->heap_low, relaxed), high = FW_LOAD(db->dir->heap_high, relaxed), unit = heap_unit(db);
    if (low < db->map.heap || low > high || high > db->map.size) return -EPROTO;
    e->cuts_off = free_run(db, high, db->map.size, cuts_bytes, db->map.granule);
    if (!e->cuts_off && cuts_bytes <= high - low) e->cuts_off = (high - cuts_bytes) / db->map.granule * db->map.granule;
    if (e->cuts_off < low) return -ENOSPC;
    if (e->cuts_off < high) high = e->cuts_off;
    e->ring_off = free_run(db, db->map.heap, high / unit * unit, ring_bytes + colour, unit);
    if (!e->ring_off) return -ENOSPC;
    e->ring_off += colour;
    return 0;
}

void fw_memory(const fw_db *db, uint64_t *size, uint64_t *unused) {
    uint64_t n = (db->map.size - db->map.heap) / db->map.granule, used = 0;
    for (uint64_t g = 0; g < n; g++) used += (uint64_t)is_used(db, g);
    *size = n * db->map.granule;
    *unused = (n - used) * db->map.granule;
}

/* -- entries ------------------------------------------------------------------------------------------------------ */

uint64_t fw_ring_bytes(uint32_t stride, uint32_t n_slots) { return sizeof(fw_ring) + (uint64_t)stride * n_slots; }
static uint64_t ring_bytes(const fw_oentry *e) { return fw_ring_bytes(e->stride, e->spec.n_slots); }
static uint64_t cuts_bytes(const fw_oentry *e) { return fw_round_up(sizeof(fw_cuts) + sizeof(fw_cut) * (uint64_t)e->spec.n_slots, 64); }
static uint64_t slot_bytes(const fw_spec *s) { return fw_round_up(sizeof(fw_slot) + sizeof(fw_cause) * (uint64_t)s->n_causes + s->size, 64); }

static int entry_ok(const fw_db *db, const fw_oentry *e) {
    uint64_t heap = db->map.size - db->map.heap;
    return e->spec.n_slots >= 4 && e->spec.n_slots <= 1u << 24 && e->spec.every >= 1 && e->spec.phase < e->spec.every &&
           e->spec.n_causes <= FW_CAUSES_MAX && e->spec.size <= 1u << 30 && e->spec.component < db->header->max_components &&
           e->stride % 64 == 0 && e->stride >= slot_bytes(&e->spec) && e->spec.min_cycle_ns >= 0 &&
           e->ring_off % 64 == 0 && e->ring_off >= db->map.heap && ring_bytes(e) <= heap &&
           e->ring_off <= db->map.size - ring_bytes(e) && e->cuts_off % 64 == 0 && e->cuts_off >= db->map.heap &&
           cuts_bytes(e) <= heap && e->cuts_off <= db->map.size - cuts_bytes(e);
}

uint32_t fw_n_entries(const fw_db *db) {
    uint32_t n = FW_LOAD(db->dir->n_entries, acquire);
    return n <= db->header->max_objects ? n : 0;
}

uint64_t fw_directory_version(const fw_db *db) { return FW_LOAD(db->dir->version, acquire); }

/* Copies what an entry says into this process, after checking every offset. -ENOENT: it is nobody's. */
int fw_ref_fill(fw_db *db, uint32_t i) {
    uint64_t life = FW_LOAD(db->life[i].life, acquire);
    if (db->refs[i].life == life && life % 2) return 0;
    fw_oentry e = db->objects[i];
    FW_FENCE(acquire);
    db->refs[i].life = 0;
    if (life % 2 == 0 || FW_LOAD(db->life[i].life, relaxed) != life) return -ENOENT;
    if (e.life != life || !entry_ok(db, &e)) return -EPROTO;
    db->refs[i] = (fw_ref){
        .life = life, .ring = (fw_ring *)(db->base + e.ring_off), .cuts = (fw_cuts *)(db->base + e.cuts_off),
        .slots = db->base + e.ring_off + sizeof(fw_ring), .stride = e.stride, .n_slots = e.spec.n_slots,
        .size = e.spec.size, .n_causes = e.spec.n_causes, .every = e.spec.every, .phase = e.spec.phase,
        .component = e.spec.component, .flags = e.spec.flags, .min_cycle_ns = e.spec.min_cycle_ns,
        .max_age_ns = e.spec.max_age_ns, .t_history_ns = e.spec.t_history_ns};
    return 0;
}

int fw_ref_get(const fw_db *db, fw_handle object, fw_ref **out) {
    uint32_t i = fw_index_of(object);
    if (object < 0 || i >= db->header->max_objects) return -ENOENT;
    uint64_t life = ((uint64_t)object >> 32) * 2 + 1;
    *out = &db->refs[i];
    if ((*out)->life == life && FW_LOAD(db->life[i].life, relaxed) == life) return 0;
    int r = fw_ref_fill((fw_db *)(uintptr_t)db, i); /* the memory of this process only */
    if (r == -EPROTO) return r;
    return (*out)->life == life ? 0 : FW_LOAD(db->life[i].life, relaxed) > life ? -EIDRM : -ENOENT;
}

void fw_ring_writable(fw_db *db, const fw_ref *ref, int on) {
    uint64_t off = (uint64_t)((uint8_t *)ref->ring - db->base), end = fw_round_up(off + fw_ring_bytes(ref->stride, ref->n_slots), FW_PAGE);
    fw_writable(db, off, end - off, on);
    if (on || db->fd < 0) return;
    off = off / FW_PAGE * FW_PAGE;
    for (uint32_t i = 0, n = fw_n_entries(db); i < n; i++) { /* in a damaged store rings may overlap: what is ours stays so */
        fw_ref *o = &db->refs[i];
        if (o == ref || !o->life || FW_LOAD(db->life[i].life, relaxed) != o->life || FW_LOAD(db->life[i].deleted, relaxed)) continue;
        uint64_t at = (uint64_t)((uint8_t *)o->ring - db->base), bytes = fw_ring_bytes(o->stride, o->n_slots);
        if (at / FW_PAGE * FW_PAGE >= end || at + bytes <= off) continue;
        o->public_mapped = 0;
        if (db->self[o->component].owned) fw_writable(db, at, bytes, 1);
    }
    if (db->has_clock && end > db->cuts_mapped) fw_writable(db, db->cuts_mapped, db->map.size - db->cuts_mapped, 1);
}

static uint64_t hash_of(const char *name) { /* FNV-1a */
    uint64_t h = 14695981039346656037ull;
    for (const char *c = name; *c && c < name + FW_NAME_MAX; c++) h = (h ^ (uint8_t)*c) * 1099511628211ull;
    return h ? h : 1;
}

fw_handle fw_find(const fw_db *db, const char *name) {
    uint64_t hash = hash_of(name);
    for (uint32_t i = 0, n = fw_n_entries(db); i < n; i++) {
        if (FW_LOAD(db->hash[i], relaxed) != hash) continue;
        uint64_t life = FW_LOAD(db->life[i].life, acquire);
        int same = strncmp(db->objects[i].spec.name, name, FW_NAME_MAX) == 0;
        FW_FENCE(acquire);
        if (same && life % 2 && FW_LOAD(db->life[i].life, relaxed) == life && !FW_LOAD(db->life[i].deleted, acquire))
            return fw_handle_of(life, i);
    }
    return -ENOENT;
}

fw_handle fw_entry(const fw_db *db, uint32_t i) {
    if (i >= fw_n_entries(db)) return -ENOENT;
    uint64_t life = FW_LOAD(db->life[i].life, acquire);
    return life % 2 && life >> 32 == 0 ? fw_handle_of(life, i) : -ENOENT;
}

int fw_object_get(const fw_db *db, fw_handle object, fw_object *out) {
    fw_ref *ref;
    int r = fw_ref_get(db, object, &ref);
    if (r < 0) return r;
    uint32_t i = fw_index_of(object);
    const fw_oentry *e = &db->objects[i];
    uint64_t deleted = FW_LOAD(db->life[i].deleted, acquire);
    *out = (fw_object){.spec = e->spec, .oid = e->oid, .t_insert_ns = e->t_insert_ns,
                       .t_delete_ns = deleted ? db->death[i].t_ns : INT64_MAX,
                       .deleted_cycle = deleted ? deleted - 1 : UINT64_MAX,
                       .head = FW_LOAD(ref->ring->head, acquire), .refused = FW_LOAD(ref->ring->refused, relaxed),
                       .t_data_ns = (int64_t)FW_LOAD(ref->ring->t_data_ns, relaxed)};
    out->spec.name[FW_NAME_MAX - 1] = 0;
    FW_FENCE(acquire);
    return fw_life_still(&db->life[i].life, ref->life);
}

static int is_mine(const fw_db *db, uint32_t component) { return component < db->header->max_components && db->self[component].owned; }

/* -- carrying out an intent: each step may be done twice ------------------------------------------------------------- */

/* The ring of a new object: from here on its owner's, if that is this process. */
static void clear_ring(fw_db *db, const fw_oentry *e) {
    fw_writable(db, e->ring_off, ring_bytes(e), 1);
    memset(db->base + e->ring_off, 0, ring_bytes(e));
    if (!is_mine(db, e->spec.component)) fw_writable(db, e->ring_off, ring_bytes(e), 0);
}

/* The cut log of a new object: the clock's. */
static void clear_cuts(fw_db *db, const fw_oentry *e) {
    static const uint8_t zeros[4096];
    for (uint64_t done = 0, n = cuts_bytes(e), part; done < n; done += part) {
        part = n - done < sizeof zeros ? n - done : sizeof zeros;
        fw_put(db, e->cuts_off + done, zeros, part);
    }
}

static void mark_ring(fw_db *db, const fw_oentry *e, int used) { /* whole pages: what a process may write */
    uint64_t unit = heap_unit(db), first = e->ring_off / unit * unit;
    if (first < db->map.heap) first = db->map.heap;
    mark(db, first, fw_round_up(e->ring_off + ring_bytes(e), unit) - first, used);
}

static void do_insert(fw_db *db, const fw_intent *t) {
    const fw_oentry *e = &t->object;
    uint32_t i = t->entry;
    if (FW_LOAD(db->life[i].life, relaxed) == e->life) goto counts; /* done already */
    mark_ring(db, e, 1);
    STEP();
    mark(db, e->cuts_off, cuts_bytes(e), 1);
    STEP();
    clear_ring(db, e);
    STEP();
    clear_cuts(db, e);
    STEP();
    fw_put(db, db->map.objects + sizeof *e * (uint64_t)i, e, sizeof *e);
    FW_STORE(db->object_wake[i], 0, relaxed);
    FW_STORE(db->life[i].deleted, 0, relaxed);
    FW_STORE(db->life[i].parent, e->spec.flags & FW_WITH_PARENT ? e->spec.parent : 0, relaxed);
    STEP();
    if (e->ring_off + ring_bytes(e) > FW_LOAD(db->dir->heap_low, relaxed))
        FW_STORE(db->dir->heap_low, fw_round_up(e->ring_off + ring_bytes(e), heap_unit(db)), relaxed);
    if (e->cuts_off < FW_LOAD(db->dir->heap_high, relaxed)) FW_STORE(db->dir->heap_high, e->cuts_off, release);
    STEP();
    FW_STORE(db->life[i].life, e->life, release); /* from here on it is there; the clock maps its cut log: with refresh */
counts:
    STEP();
    FW_STORE(db->hash[i], hash_of(e->spec.name), release);
    if (FW_LOAD(db->dir->next_oid, relaxed) <= e->oid) FW_STORE(db->dir->next_oid, e->oid + 1, relaxed);
    if (FW_LOAD(db->dir->next_life, relaxed) <= e->life / 2) FW_STORE(db->dir->next_life, e->life / 2 + 1, relaxed);
    STEP();
    if (fw_n_entries(db) <= i) FW_STORE(db->dir->n_entries, i + 1, release);
}

static void delete_one(fw_db *db, uint32_t i, const fw_intent *t) {
    db->death[i].t_ns = t->t_ns;
    STEP();
    FW_STORE(db->hash[i], 0, relaxed);
    uint64_t deleted = t->cycle < UINT64_MAX ? t->cycle + 1 : UINT64_MAX;
    FW_STORE(db->life[i].deleted, deleted, relaxed);
    STEP();
    FW_FENCE(seq_cst); /* a tick that does not see this is at most the one after the cycle read here: with fw_tick */
    db->death[i].spent_cycle = fw_cycle(db) + 1 > deleted ? fw_cycle(db) + 1 : deleted;
    STEP();
}

/* The object, then every living one below it that goes with its parent. */
static void do_delete(fw_db *db, const fw_intent *t) {
    uint32_t n = fw_n_entries(db), found = 1;
    delete_one(db, t->entry, t);
    while (found) {
        found = 0;
        for (uint32_t i = 0; i < n; i++) {
            uint64_t parent = FW_LOAD(db->life[i].parent, relaxed);
            if (!parent || FW_LOAD(db->life[i].life, relaxed) % 2 == 0 ||
                (FW_LOAD(db->life[i].deleted, relaxed) && db->death[i].spent_cycle >= FW_LOAD(db->life[i].deleted, relaxed))) continue;
            for (uint32_t k = 0; k < n; k++)
                if (FW_LOAD(db->life[k].life, relaxed) % 2 && FW_LOAD(db->life[k].deleted, relaxed) &&
                    db->objects[k].oid == parent) { delete_one(db, i, t); found = 1; break; }
        }
    }
}

static void do_free(fw_db *db, const fw_intent *t) {
    fw_oentry *e = &db->objects[t->entry];
    fw_life_end(&db->life[t->entry].life, (e->life | 1) + 1);
    STEP();
    mark_ring(db, e, 0);
    STEP();
    mark(db, e->cuts_off, cuts_bytes(e), 0);
    STEP();
}

static void carry_out(fw_db *db) {
    fw_intent *t = &db->dir->intent;
    uint32_t kind = FW_LOAD(t->kind, acquire);
    STEP();
    if (kind == FW_INSERT) do_insert(db, t);
    if (kind == FW_DELETE) do_delete(db, t);
    if (kind == FW_FREE) do_free(db, t);
    FW_STORE(db->dir->version, t->version, seq_cst); /* with fw_tick, which looks after its epoch */
    STEP();
    FW_STORE(t->kind, FW_NOTHING, release);
    STEP();
}

/* The rest of the intent stands; from here on it will be carried out, by this process or by a later one. */
static void decide(fw_db *db, uint32_t kind) {
    db->dir->intent.version = FW_LOAD(db->dir->version, relaxed) + 1;
    STEP();
    FW_STORE(db->dir->intent.kind, kind, release);
    carry_out(db);
}

static int intent_ok(const fw_db *db, const fw_intent *t) { /* of a segment that may be damaged */
    uint32_t kind = FW_LOAD(((fw_intent *)(uintptr_t)t)->kind, relaxed);
    if (kind == FW_NOTHING) return 1;
    if (kind > FW_FREE || t->entry >= db->header->max_objects) return 0;
    return entry_ok(db, kind == FW_INSERT ? &t->object : &db->objects[t->entry]);
}

int fw_directory_open(fw_db *db) {
    int r = 0;
    for (int i = 0; i < 20000; i++) { /* the holder needs microseconds; the kernel frees it when it dies */
        r = fw_lock(db, FW_LOCK_DIRECTORY, F_WRLCK);
        if (r != -EBUSY) break;
        if (i < 20) sched_yield();
        else fw_platform_sleep_until(fw_platform_monotonic_ns() + 50000);
    }
    if (r < 0) return r;
    r = fw_writable(db, db->map.directory, db->map.components - db->map.directory, 1);
    if (r == 0 && !intent_ok(db, &db->dir->intent)) r = -EPROTO;
    if (r < 0) { fw_directory_close(db); return r; }
    if (FW_LOAD(db->dir->intent.kind, relaxed) != FW_NOTHING) carry_out(db); /* its author was killed */
    return 0;
}

void fw_directory_close(fw_db *db) {
    fw_writable(db, db->map.directory, db->map.components - db->map.directory, 0);
    fw_lock(db, FW_LOCK_DIRECTORY, F_UNLCK);
}

/* -- inserting, deleting, giving storage back --------------------------------------------------------------------- */

int fw_name_ok(const char *name) {
    size_t n = strnlen(name, FW_NAME_MAX);
    if (n == 0 || n == FW_NAME_MAX) return 0;
    for (size_t i = 0; i < n; i++)
        if ((unsigned char)name[i] <= ' ' || name[i] == '#' || name[i] == 127) return 0;
    return name[0] != '/' && name[n - 1] != '/';
}

static int is_gone(const fw_db *db, uint32_t component) { return !fw_component_alive(db, component); }

/* Nobody reads, writes or ticks the storage of a deleted object any more: its history had its time, no tick that began
 * before the deletion is under way, and its owner has noticed (or is gone). */
static int is_spent(fw_db *db, uint32_t i) {
    uint64_t deleted = FW_LOAD(db->life[i].deleted, relaxed);
    const fw_oentry *e = &db->objects[i];
    if (FW_LOAD(db->life[i].life, relaxed) % 2 == 0 || !deleted || !entry_ok(db, e)) return 0;
    if (!(e->spec.flags & FW_IMMEDIATE_DELETE) && fw_now_ns(db) - db->death[i].t_ns < e->spec.t_history_ns) return 0;
    if (db->fd < 0) return 1;
    if (fw_cycle(db) < db->death[i].spent_cycle && !db->has_clock && fw_lock_held(db, FW_LOCK_CLOCK)) return 0;
    if (e->spec.flags & FW_PUBLIC_WRITE) { /* whoever gets the lock after us sees that it is deleted */
        int r = fw_lock(db, FW_LOCK_OBJECT + (int64_t)i, F_WRLCK);
        if (r == 0) fw_lock(db, FW_LOCK_OBJECT + (int64_t)i, F_UNLCK);
        return r == 0;
    }
    return FW_LOAD(((fw_ring *)(db->base + e->ring_off))->released, acquire) || is_mine(db, e->spec.component) ||
           is_gone(db, e->spec.component);
}

static void free_spent(fw_db *db) {
    for (uint32_t i = 0, n = fw_n_entries(db); i < n; i++)
        if (FW_LOAD(db->life[i].deleted, relaxed) && is_spent(db, i)) {
            db->dir->intent.entry = i;
            decide(db, FW_FREE);
        }
}

/* What dead components left and nobody took over goes when there is no room otherwise, as if it had been deleted at its
 * last write. */
static void delete_abandoned(fw_db *db) {
    for (uint32_t i = 0, n = fw_n_entries(db); i < n; i++) {
        const fw_oentry *e = &db->objects[i];
        if (FW_LOAD(db->life[i].life, relaxed) % 2 == 0 || FW_LOAD(db->life[i].deleted, relaxed) || !entry_ok(db, e) ||
            e->spec.flags & FW_PERSISTENT || is_mine(db, e->spec.component) || !is_gone(db, e->spec.component)) continue;
        fw_ring *ring = (fw_ring *)(db->base + e->ring_off);
        int64_t last = (int64_t)FW_LOAD(ring->t_commit_ns, relaxed);
        if (last < e->t_insert_ns) last = e->t_insert_ns;
        if (fw_now_ns(db) - last < e->spec.t_history_ns) continue;
        fw_intent *t = &db->dir->intent;
        t->entry = i;
        t->cycle = fw_cycle(db);
        t->t_ns = last;
        decide(db, FW_DELETE);
        fw_tell(db, &db->object_wake[i]);
    }
}

static void delete_locked(fw_db *db, fw_handle object, fw_ref *ref) {
    fw_intent *t = &db->dir->intent;
    int mine = is_mine(db, ref->component);
    if (mine && !(ref->flags & FW_PUBLIC_WRITE)) FW_STORE(ref->ring->released, 1, release); /* this process writes it no more */
    ref->begun = 0;
    t->entry = fw_index_of(object);
    t->cycle = fw_cycle(db);
    t->t_ns = fw_now_ns(db);
    decide(db, FW_DELETE);
    if (mine) fw_ring_writable(db, ref, 0);
    for (uint32_t k = 0, n = fw_n_entries(db); k < n; k++) /* with all that went with it */
        if (FW_LOAD(db->life[k].deleted, relaxed)) fw_tell(db, &db->object_wake[k]);
}

void fw_make_room(fw_db *db) {
    delete_abandoned(db);
    free_spent(db);
}

/* Whether the object of that id lives, and still will when the one in entry `goes` was deleted. */
static int stays(const fw_db *db, uint64_t oid, uint32_t goes) {
    uint32_t n = fw_n_entries(db);
    for (uint32_t depth = 0; depth <= n; depth++) {
        uint32_t i = 0;
        while (i < n && (FW_LOAD(db->life[i].life, relaxed) % 2 == 0 || FW_LOAD(db->life[i].deleted, relaxed) || db->objects[i].oid != oid)) i++;
        if (i == n || i == goes) return depth > 0 && i == n;
        if (goes == UINT32_MAX || !(oid = FW_LOAD(db->life[i].parent, relaxed))) return 1;
    }
    return 0;
}

static fw_handle insert_locked(fw_db *db, const fw_spec *spec) {
    fw_handle old = fw_find(db, spec->name);
    fw_ref *ref = NULL;
    if (old >= 0 && (!(spec->flags & FW_REPLACE) || fw_ref_get(db, old, &ref) < 0 || ref->component != spec->component)) return -EEXIST;
    if (spec->parent && !stays(db, spec->parent, old >= 0 ? fw_index_of(old) : UINT32_MAX)) return -EIDRM;
    uint32_t n = fw_n_entries(db), i = 0;
    while (i < n && FW_LOAD(db->life[i].life, relaxed) % 2) i++;
    if (i >= db->header->max_objects) return -ENOSPC;
    fw_intent *t = &db->dir->intent;
    uint64_t life = FW_LOAD(db->dir->next_life, relaxed) * 2 + 1;
    if (life >> 32) return -ENOSPC; /* two thousand million inserts */
    fw_oentry e = {.spec = *spec, .life = life, .oid = FW_LOAD(db->dir->next_oid, relaxed),
                   .t_insert_ns = fw_now_ns(db), .stride = (uint32_t)slot_bytes(spec)};
    e.spec.flags &= ~FW_REPLACE;
    int64_t period_ns = (int64_t)spec->every * fw_tick_ns(db);
    if (!e.spec.t_history_ns) e.spec.t_history_ns = period_ns * spec->n_slots;
    if (!e.spec.min_cycle_ns) e.spec.min_cycle_ns = period_ns;
    int r = place(db, &e, i, ring_bytes(&e), cuts_bytes(&e));
    if (r < 0) return r;
    if (old >= 0) delete_locked(db, old, ref);
    t->entry = i;
    t->object = e;
    decide(db, FW_INSERT);
    return fw_handle_of(e.life, i);
}

fw_handle fw_insert(fw_db *db, const fw_spec *spec) {
    if (!fw_name_ok(spec->name) || spec->n_slots < 4 || spec->n_slots > 1u << 24 || spec->every < 1 ||
        spec->phase >= spec->every || spec->n_causes > FW_CAUSES_MAX || spec->size > 1u << 30 || spec->t_history_ns < 0 ||
        spec->min_cycle_ns < 0 || spec->max_age_ns < 0) return -EINVAL;
    if (!is_mine(db, spec->component)) return -EPERM;
    int r = fw_directory_open(db);
    if (r < 0) return r;
    free_spent(db);
    fw_handle h = insert_locked(db, spec);
    if (h == -ENOSPC) {
        fw_make_room(db);
        h = insert_locked(db, spec);
    }
    fw_ref *ref;
    if (h >= 0) r = fw_ref_get(db, h, &ref); /* its ring is writable here already: do_insert */
    fw_directory_close(db);
    if (h >= 0) fw_tell(db, &db->wake->directory);
    return r < 0 ? r : h;
}

int fw_delete(fw_db *db, fw_handle object) {
    fw_ref *ref;
    int r = fw_directory_open(db);
    if (r < 0) return r;
    uint32_t i = fw_index_of(object);
    r = fw_ref_get(db, object, &ref);
    if (r == 0 && FW_LOAD(db->life[i].deleted, relaxed)) r = -EIDRM;
    if (r == 0 && !is_mine(db, ref->component) && !(ref->flags & FW_PUBLIC_WRITE) && !is_gone(db, ref->component)) r = -EPERM;
    if (r == 0) delete_locked(db, object, ref);
    fw_directory_close(db);
    if (r == 0) fw_tell(db, &db->wake->directory);
    return r;
}

/* -- schemas -------------------------------------------------------------------------------------------------------- */

int fw_schema_get(const fw_db *db, uint32_t schema, const char **text, uint32_t *n) {
    uint32_t used = FW_LOAD(db->dir->schema_used, acquire), off = 0, length;
    if (used > db->header->schema_bytes) return -EPROTO;
    for (uint32_t i = 0; used - off >= 8; i++) {
        memcpy(&length, db->schemas + off, 4);
        if (length > used - off - 4) return -EPROTO;
        if (i == schema) { *text = (const char *)db->schemas + off + 4; *n = length; return 0; }
        off += (uint32_t)fw_round_up(4 + (uint64_t)length, 8);
        if (off > used) return -EPROTO;
    }
    return -ENOENT;
}

int fw_schema_add(fw_db *db, const char *text, uint32_t n) {
    int r = fw_directory_open(db);
    if (r < 0) return r;
    const char *known;
    uint32_t length, i = 0;
    while ((r = fw_schema_get(db, i, &known, &length)) == 0 && (length != n || memcmp(known, text, n) != 0)) i++;
    if (r == -ENOENT) { /* published by the length that is used: killed before that, nothing has happened */
        uint32_t used = FW_LOAD(db->dir->schema_used, relaxed);
        uint64_t end = used + fw_round_up(4 + (uint64_t)n, 8);
        if (end > db->header->schema_bytes) r = -ENOSPC;
        else if ((r = fw_put(db, db->map.schemas + used, &n, 4)) == 0 && (r = fw_put(db, db->map.schemas + used + 4, text, n)) == 0) {
            STEP();
            FW_STORE(db->dir->schema_used, (uint32_t)end, release);
        }
    }
    fw_directory_close(db);
    return r < 0 ? r : (int)i;
}
