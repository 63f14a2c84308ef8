/* consistency.h - what must hold in the directory of a store while its lock is held: for tests that kill and damage. */
#ifndef FW_CONSISTENCY_H
#define FW_CONSISTENCY_H

#include <stdio.h>

#include "fw_layout.h"

#define FW_NOT(what, ...) return snprintf(text, n, what, __VA_ARGS__), text

/* In a shared store a ring has its pages for itself. */
static inline uint64_t ring_unit(const fw_db *db) { return db->fd >= 0 && db->map.granule < FW_PAGE ? FW_PAGE : db->map.granule; }
static inline uint64_t ring_begin(const fw_db *db, const fw_oentry *e) {
    uint64_t first = e->ring_off / ring_unit(db) * ring_unit(db);
    return first < db->map.heap ? db->map.heap : first;
}
static inline uint64_t ring_end(const fw_db *db, const fw_oentry *e) {
    uint64_t end = fw_round_up(e->ring_off + fw_ring_bytes(e->stride, e->spec.n_slots), ring_unit(db));
    return end > db->map.size ? db->map.size : end;
}
static inline uint64_t cuts_end(const fw_oentry *e) {
    return e->cuts_off + fw_round_up(sizeof(fw_cuts) + sizeof(fw_cut) * (uint64_t)e->spec.n_slots, 64);
}

/* NULL when nobody owns a byte twice, nothing is used that nobody owns, and every living object is found by its name and
 * belongs to a component that has one. Otherwise what does not hold, in `text`. */
static inline const char *inconsistent(const fw_db *db, char *text, size_t n) {
    static uint16_t owner[FW_GRANULES]; /* 1 + the entry that has it */
    uint64_t granules = (db->map.size - db->map.heap) / db->map.granule;
    memset(owner, 0, sizeof owner);
    if (FW_LOAD(db->dir->intent.kind, relaxed) != FW_NOTHING)
        FW_NOT("an intent is left: %u", FW_LOAD(db->dir->intent.kind, relaxed));
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        const fw_oentry *e = &db->objects[i];
        uint64_t life = FW_LOAD(db->life[i].life, relaxed), deleted = FW_LOAD(db->life[i].deleted, relaxed);
        if (life % 2 == 0) continue;
        const char *name = e->spec.name;
        if (e->life != life) FW_NOT("entry %u has life %lu and says %lu", i, (unsigned long)life, (unsigned long)e->life);
        if (life / 2 >= FW_LOAD(db->dir->next_life, relaxed)) FW_NOT("%s: its life will be given again", name);
        if (e->oid >= FW_LOAD(db->dir->next_oid, relaxed)) FW_NOT("%s: its id will be given again", name);
        if (ring_end(db, e) > FW_LOAD(db->dir->heap_low, relaxed)) FW_NOT("%s: its ring lies where cut logs may be put", name);
        if (e->cuts_off < FW_LOAD(db->dir->heap_high, relaxed)) FW_NOT("%s: its cut log lies where rings may be put", name);
        if (e->spec.component >= fw_n_components(db)) FW_NOT("%s belongs to no component", name);
        if (!db->components[e->spec.component].name[0]) FW_NOT("%s belongs to a component that has lost its name", name);
        if (!deleted && fw_find(db, name) != fw_handle_of(life, i)) FW_NOT("%s is not found by its name", name);
        if (deleted && FW_LOAD(db->hash[i], relaxed)) FW_NOT("%s is deleted and can be found", name);
        if (deleted && db->death[i].spent_cycle < deleted)
            FW_NOT("%s is deleted, and a tick that still knows it is not waited for", name);
        uint64_t range[2][2] = {{ring_begin(db, e), ring_end(db, e)}, {e->cuts_off, cuts_end(e)}};
        for (int k = 0; k < 2; k++)
            for (uint64_t off = range[k][0]; off < range[k][1]; off += db->map.granule) {
                uint64_t g = (off - db->map.heap) / db->map.granule;
                if (owner[g]) FW_NOT("%s and %s share memory", name, db->objects[owner[g] - 1].spec.name);
                owner[g] = (uint16_t)(i + 1);
            }
    }
    for (uint64_t g = 0; g < granules; g++) {
        int used = (int)(FW_LOAD(db->dir->used[g / 64], relaxed) >> (g % 64) & 1);
        if (used && !owner[g]) FW_NOT("granule %lu of %lu is used by nobody", (unsigned long)g, (unsigned long)granules);
        if (!used && owner[g]) FW_NOT("%s lies in memory that counts as unused", db->objects[owner[g] - 1].spec.name);
    }
    for (uint32_t i = 0; i < fw_n_components(db); i++)
        for (uint32_t k = 0; k < i; k++)
            if (db->components[i].name[0] && strncmp(db->components[i].name, db->components[k].name, FW_NAME_MAX) == 0)
                FW_NOT("components %u and %u are both called \"%s\"", k, i, db->components[i].name);
    const char *schema;
    uint32_t bytes, i = 0;
    int r;
    while ((r = fw_schema_get(db, i, &schema, &bytes)) == 0) i++;
    if (r != -ENOENT) FW_NOT("schema %u: %d", i, r);
    return NULL;
}

#endif
