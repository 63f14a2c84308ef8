/* components.c - who is attached under a name: ownership, health, life and death. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdio.h>
#include <unistd.h>

#include "fw_layout.h"

/* -- health: an object like any other, so that tools, recordings and files show it ---------------------------------- */

#define FIELD(name, kind, n, shape, unit, doc, number, values) \
    "{\"name\":\"" name "\",\"kind\":\"" kind "\",\"unit\":\"" unit "\",\"doc\":\"" doc "\",\"n\":" n ",\"shape\":\"" shape \
    "\",\"number\":" number ",\"values\":{" values "}}"
static const char health_schema[] =
    "{\"name\":\"Health\",\"doc\":\"How a component is.\",\"size\":376,\"fields\":["
    FIELD("pid", "i64", "1", "one", "", "process", "1", "") ","
    FIELD("steps", "u64", "1", "one", "", "cycles that it finished", "2", "") ","
    FIELD("missed", "u64", "1", "one", "", "due cycles that ended without it", "3", "") ","
    FIELD("run_us", "u32", "20", "array", "", "steps that took 2^k us and more, by k", "4", "") ","
    FIELD("lateness_us", "u32", "20", "array", "", "steps that began 2^k us and more behind their edge, by k", "5", "") ","
    FIELD("state", "enum", "1", "one", "", "how it says that it is", "6",
          "\"UNKNOWN\":0,\"RUNNING\":1,\"WAITING\":2,\"WARNING\":3,\"FAILURE\":4") ","
    FIELD("version", "str", "31", "one", "", "of its program", "7", "") ","
    FIELD("status", "str", "160", "one", "", "what it says", "8", "") "]}";

static uint64_t missed_of(const fw_db *db, uint32_t i) { return FW_LOAD(db->missed[i], relaxed) - db->components[i].missed_before; }

static void health_write(fw_db *db, uint32_t component) {
    fw_self *self = &db->self[component];
    if (self->health < 0) return;
    self->state.missed = missed_of(db, component);
    if (fw_write(db, self->health, &self->state, sizeof self->state, fw_now_ns(db), NULL, 0) > 0) self->told_ns = fw_now_ns(db);
}

/* Shared stores only: in a private one there is nobody to tell. Without room for it a component lives without. */
static void health_begin(fw_db *db, uint32_t component, const char *version) {
    fw_self *self = &db->self[component];
    fw_spec spec = {.size = sizeof(fw_health), .n_slots = 16, .every = 1, .component = component, .flags = FW_HOST_DEPENDENT};
    int schema = fw_schema_add(db, health_schema, sizeof health_schema - 1);
    int n = snprintf(spec.name, sizeof spec.name, "%s/health", db->components[component].name);
    _Static_assert(sizeof(fw_health) == 376, "as in the schema");
    self->health = -ENOENT;
    if (schema < 0 || n >= (int)sizeof spec.name) return;
    spec.schema = (uint32_t)schema;
    self->health = fw_find(db, spec.name);
    fw_object known;
    if (self->health >= 0 && (fw_object_get(db, self->health, &known) < 0 || known.spec.schema != spec.schema)) { self->health = -ENOENT; return; }
    if (self->health < 0) self->health = fw_insert(db, &spec);
    self->state = (fw_health){.pid = getpid(), .state = 1};
    snprintf(self->state.version, sizeof self->state.version, "%s", version);
    health_write(db, component);
}

int fw_status(fw_db *db, uint32_t component, uint8_t state, const char *text) {
    if (component >= fw_n_components(db) || !db->self[component].owned) return -EPERM;
    if (state > 4 || strlen(text) > sizeof db->self[component].state.status) return -EINVAL;
    fw_health *health = &db->self[component].state;
    health->state = state;
    memset(health->status, 0, sizeof health->status);
    memcpy(health->status, text, strlen(text));
    health_write(db, component);
    return 0;
}

/* -- pace --------------------------------------------------------------------------------------------------------- */

typedef struct { uint32_t every, phase; uint64_t after; } pace;

/* The first cycle after `after` that is due. */
static uint64_t next_due(uint64_t after, uint32_t every, uint32_t phase) {
    return after + 1 + (every + phase - (after + 1) % every) % every;
}

static int64_t is_due(fw_db *db, const void *what) {
    const pace *p = what;
    uint64_t c = fw_cycle(db), due = next_due(p->after, p->every, p->phase);
    return c >= due ? (int64_t)(due + (c - due) / p->every * p->every) : 0; /* the latest one: what was missed is missed */
}

int64_t fw_step(fw_db *db, uint32_t component, int64_t timeout_ns) {
    if (component >= fw_n_components(db) || !db->self[component].owned) return -EPERM;
    fw_self *self = &db->self[component];
    pace p = {self->every, self->phase, self->begun};
    int64_t c = fw_wait_for(db, &db->wake->clock, is_due, &p, fw_platform_monotonic_ns() + timeout_ns);
    if (c < 0) return c;
    self->begun = (uint64_t)c;
    self->begun_ns = fw_platform_monotonic_ns();
    if (db->header->kind == FW_REAL)
        self->state.lateness_us[fw_bin_of(fw_now_ns(db) - fw_t0_ns(db) - c * db->header->tick_ns)]++;
    return c;
}

void fw_health_step(fw_db *db, uint32_t component, uint64_t cycle) {
    fw_self *self = &db->self[component];
    self->state.steps++;
    if (self->begun == cycle && self->begun_ns) self->state.run_us[fw_bin_of(fw_platform_monotonic_ns() - self->begun_ns)]++;
    if (db->fd >= 0 && fw_now_ns(db) - self->told_ns >= 1000000000) health_write(db, component);
}

/* -- the table ------------------------------------------------------------------------------------------------------ */

uint32_t fw_n_components(const fw_db *db) {
    uint32_t n = FW_LOAD(db->dir->n_components, acquire);
    return n <= db->header->max_components ? n : 0;
}

int fw_component_alive(const fw_db *db, uint32_t i) {
    return i < db->header->max_components && (db->self[i].owned || (db->fd >= 0 && fw_lock_held(db, FW_LOCK_COMPONENT + (int64_t)i)));
}

static int component_find(const fw_db *db, const char *name) {
    for (uint32_t i = 0; i < fw_n_components(db); i++)
        if (strncmp(db->components[i].name, name, FW_NAME_MAX) == 0) return (int)i;
    return -ENOENT;
}

/* A place of a component that is gone and has no objects any more. */
static int component_vacant(const fw_db *db) {
    for (uint32_t c = 0; c < fw_n_components(db); c++) {
        if (fw_component_alive(db, c)) continue;
        uint32_t i = 0, n = fw_n_entries(db);
        while (i < n && (FW_LOAD(db->life[i].life, relaxed) % 2 == 0 || db->objects[i].spec.component != c)) i++;
        if (i == n) return (int)c;
    }
    return -ENOSPC;
}

/* Takes over what a dead predecessor left. */
static void take_over(fw_db *db, uint32_t component) {
    for (uint32_t i = 0, n = fw_n_entries(db); i < n; i++) {
        fw_ref *ref = &db->refs[i];
        if (fw_ref_fill(db, i) < 0 || ref->component != component) continue;
        fw_ring_writable(db, ref, 1);
        if (!FW_LOAD(db->life[i].deleted, relaxed)) { fw_restamp(ref); continue; }
        FW_STORE(ref->ring->released, 1, release); /* the one who might have been writing it is gone */
        fw_ring_writable(db, ref, 0);
    }
}

static int join_locked(fw_db *db, const char *name, const fw_join_opts *opts) {
    int i = component_find(db, name);
    uint32_t n = fw_n_components(db);
    if (i < 0) i = n < db->header->max_components ? (int)n : component_vacant(db);
    if (i < 0) { fw_make_room(db); i = component_vacant(db); }
    if (i < 0) return i;
    if (db->self[i].owned) return -EBUSY;
    int r = fw_lock(db, FW_LOCK_COMPONENT + i, F_WRLCK);
    if (r < 0) return r;
    fw_centry entry = {.pid = getpid(), .participant = opts->participant != 0,
                       .every = opts->every ? opts->every : 1, .phase = opts->phase};
    const fw_centry *was = &db->components[i];
    int same = (uint32_t)i < n && strncmp(was->name, name, FW_NAME_MAX) == 0;
    entry.born_cycle = same ? was->born_cycle : fw_cycle(db);
    entry.missed_before = same ? was->missed_before : FW_LOAD(db->missed[i], relaxed);
    snprintf(entry.name, sizeof entry.name, "%s", name);
    snprintf(entry.version, sizeof entry.version, "%s", opts->version ? opts->version : "");
    r = fw_put(db, db->map.components + sizeof entry * (uint64_t)i, &entry, sizeof entry);
    if (r < 0) { fw_lock(db, FW_LOCK_COMPONENT + i, F_UNLCK); return r; }
    if ((uint32_t)i == n) FW_STORE(db->dir->n_components, n + 1, release);
    uint64_t cycle = fw_cycle(db);
    FW_STORE(db->done[i], cycle, relaxed); /* owes nothing yet */
    db->self[i] = (fw_self){.owned = 1, .every = entry.every, .phase = entry.phase, .begun = cycle, .health = -ENOENT};
    db->n_owned++;
    take_over(db, (uint32_t)i);
    return i;
}

int fw_join(fw_db *db, const char *name, const fw_join_opts *opts) {
    static const fw_join_opts none;
    if (!opts) opts = &none;
    if (!fw_name_ok(name) || strchr(name, '/') || (opts->every && opts->phase >= opts->every)) return -EINVAL;
    int r = fw_directory_open(db);
    if (r < 0) return r;
    r = join_locked(db, name, opts);
    fw_directory_close(db);
    if (r < 0) return r;
    if (db->fd >= 0) health_begin(db, (uint32_t)r, opts->version ? opts->version : "");
    fw_tell(db, &db->wake->directory);
    return r;
}

int fw_leave(fw_db *db, uint32_t component) {
    if (component >= fw_n_components(db) || !db->self[component].owned) return -EPERM;
    db->self[component].owned = 0;
    db->n_owned--;
    for (uint32_t i = 0, n = fw_n_entries(db); i < n; i++) /* what was begun is not committed after coming back */
        if (db->refs[i].life && db->refs[i].component == component && FW_LOAD(db->life[i].life, relaxed) == db->refs[i].life) {
            db->refs[i].begun = 0;
            db->refs[i].public_mapped = 0;
            fw_ring_writable(db, &db->refs[i], 0);
        }
    int r = fw_lock(db, FW_LOCK_COMPONENT + component, F_UNLCK);
    fw_tell(db, &db->wake->done);
    return r;
}

int fw_component_get(const fw_db *db, uint32_t i, fw_component *out) {
    if (i >= fw_n_components(db)) return -ENOENT;
    const fw_centry *e = &db->components[i];
    *out = (fw_component){.pid = e->pid, .participant = e->participant != 0, .every = e->every, .phase = e->phase,
                          .done = FW_LOAD(db->done[i], acquire), .missed = missed_of(db, i),
                          .alive = fw_component_alive(db, i)};
    memcpy(out->name, e->name, FW_NAME_MAX - 1);
    memcpy(out->version, e->version, sizeof out->version - 1);
    return 0;
}

/* -- life and death, as the clock saw them -------------------------------------------------------------------------- */

fw_cuts *fw_life_log(const fw_db *db, uint32_t i) {
    return (fw_cuts *)(db->lives + (sizeof(fw_cuts) + FW_LIVES * sizeof(fw_cut)) * i);
}

int fw_alive_at(const fw_db *db, uint32_t component, uint64_t cycle) {
    if (component >= fw_n_components(db)) return -ENOENT;
    if (cycle > fw_cycle(db)) return -EDOM;
    if (cycle < db->components[component].born_cycle) return 0;
    int64_t r = fw_cut_find(fw_life_log(db, component), FW_LIVES, cycle);
    return r < 0 ? (int)r : r == 2;
}

/* Whether a participant was due up to a cycle and is not done with it. */
static int owes(const fw_db *db, uint32_t i, uint64_t cycle) {
    const fw_centry *e = &db->components[i];
    if (!e->participant) return 0;
    uint64_t done = FW_LOAD(db->done[i], acquire);
    return done < cycle && (e->every <= 1 || next_due(done, e->every, e->phase % e->every) <= cycle);
}

static int64_t all_done(fw_db *db, const void *what) {
    uint64_t cycle = *(const uint64_t *)what;
    for (uint32_t i = 0; i < fw_n_components(db); i++)
        if (owes(db, i, cycle) && fw_component_alive(db, i)) return 0;
    return 1;
}

int fw_done(fw_db *db, uint32_t component, uint64_t cycle) {
    if (component >= fw_n_components(db) || !db->self[component].owned) return -EPERM;
    FW_STORE(db->done[component], cycle, release);
    FW_FENCE(seq_cst); /* of two that finish at once, at least one sees that both have */
    uint32_t i = 0, n = fw_n_components(db);
    while (i < n && !owes(db, i, cycle)) i++;
    if (i == n) fw_tell(db, &db->wake->done); /* who ticks is not woken for each; it sees the dead ones by itself */
    if (db->fd >= 0) fw_health_step(db, component, cycle);
    return 0;
}

int fw_wait_done(fw_db *db, uint64_t cycle, int64_t timeout_ns) {
    int64_t r = fw_wait_for(db, &db->wake->done, all_done, &cycle, fw_platform_monotonic_ns() + timeout_ns);
    return r < 0 ? (int)r : 0;
}
