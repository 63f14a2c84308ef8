/* fw_rtdb.h - the Fairway real-time database: public C interface, and its manual.
 *
 * One segment of memory holds objects. An object is a ring of slots; one component (its owner) writes it, anybody
 * reads it. What was written becomes visible at clock edges: tick c fixes, for every object that is due at c, which
 * write its readers see, and the choices of one tick form a consistent cut (no effect without its cause).
 *
 *   segment   | header | directory | schemas | wake words | clock | heap: rings ->        <- cut logs |
 *             |  read-only for readers       | writable  | clock's| each owner's own | the clock's    |
 *
 * The segment is a file in /dev/shm shared by processes, or private memory of one process: the same code.
 *
 * Failure: every function that can fail returns a negative errno value:
 *   -EAGAIN     nothing is there yet (no write, not visible at that cycle)
 *   -ESTALE     it was there and aged out of the history
 *   -EDOM       the cycle lies in the future
 *   -EBUSY      held by another process (name, component, clock), or a writer is too fast: its next slot is
 *               still named by one of the two newest cuts
 *   -EPERM      the caller does not own what it wants to write, or holds no clock
 *   -ENOENT     no such store, component or object       -EEXIST  the name is taken
 *   -EPROTO     not a store, damaged, or made by another layout
 *   -EMSGSIZE   larger than the object's slots           -ENOSPC  the segment, or one of its tables, is full
 *   -EINVAL     an argument out of range                 -ETIMEDOUT
 * Nothing is changed by a call that fails.
 *
 * Threads: one fw_db belongs to one thread at a time. Processes: any number. Killing a process at any instruction
 * blocks nobody: locks are kernel file locks (released by the kernel), data is never locked.
 */
#ifndef FW_RTDB_H
#define FW_RTDB_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define FW_LAYOUT 1u        /* changes with every change of the layout in fw_layout.h */
#define FW_NAME_MAX 64u     /* bytes of a name with its final NUL */
#define FW_CAUSES_MAX 8u    /* writes that one write may name as its causes */

typedef struct fw_db fw_db;

/* What fw_create needs. Zero means the default in brackets. */
typedef struct {
    uint64_t size;            /* bytes of the segment [4 MiB] */
    uint32_t max_objects;     /* [256] */
    uint32_t max_components;  /* [64] */
    uint32_t schema_bytes;    /* room for schemas [256 KiB] */
    int64_t tick_ns;          /* base tick [10 ms] */
    int64_t t0_ns;            /* time of cycle 0, ns since 1970 */
} fw_opts;

/* What fw_insert needs. */
typedef struct {
    char name[FW_NAME_MAX];   /* "component/object" */
    uint32_t schema;          /* from fw_schema_add */
    uint32_t size;            /* largest payload, bytes */
    uint32_t n_slots;         /* at least 4: two cuts, the newest write, the one under construction */
    uint32_t every, phase;    /* due at ticks c with c % every == phase */
    uint32_t flags;           /* kept for the caller: the store does not look at them */
    uint32_t n_causes;        /* room for causes in each slot, at most FW_CAUSES_MAX */
    uint32_t component;       /* owner, from fw_join */
    uint64_t parent;          /* object id, 0 = none */
} fw_spec;

typedef struct {
    fw_spec spec;
    uint64_t oid;             /* never reused within a store */
    uint64_t head;            /* newest write number */
    uint64_t refused;         /* writes refused as too fast */
} fw_object;

typedef struct {
    char name[FW_NAME_MAX];
    int64_t pid;              /* of the latest owner */
    int alive;                /* its lock is held */
    uint64_t done;            /* newest cycle it reported done */
    int participant;          /* the barrier waits for it */
} fw_component;

typedef struct { uint64_t oid, write; } fw_cause;

typedef struct {
    uint64_t write;           /* write number, 1, 2, 3, ... per object */
    int64_t t_commit_ns;      /* store time at which it was written */
    int64_t t_data_ns;        /* when what it tells was true; never decreases per object */
    uint32_t size;
    uint32_t n_causes;
    fw_cause causes[FW_CAUSES_MAX];
} fw_info;

/* -- stores -------------------------------------------------------------------------------------------------- */

/* Makes a store: private memory when name is NULL, else a segment that others can attach. -EBUSY if a living
 * process has a store of that name; a store that a crash left behind is replaced. The creator holds the clock. */
int fw_create(fw_db **out, const char *name, const fw_opts *opts);
/* Attaches to a store. -ENOENT, -EPROTO. Only what this process comes to own is mapped writable. */
int fw_attach(fw_db **out, const char *name);
/* Gives everything back; the creator also removes the name. */
void fw_close(fw_db *db);
int64_t fw_tick_ns(const fw_db *db);
int64_t fw_t0_ns(const fw_db *db);
uint64_t fw_store_id(const fw_db *db);
/* Copies a private store to and from a buffer of fw_image_size bytes (0: not a private store). */
size_t fw_image_size(const fw_db *db);
int fw_save(const fw_db *db, void *image, size_t n);
int fw_restore(fw_db *db, const void *image, size_t n);

/* -- components, schemas, objects ------------------------------------------------------------------------------ */

/* Becomes the component `name`, new or left behind by a dead process, whose objects it takes over. -EBUSY if it
 * lives. A participant is waited for by fw_wait_done. Returns its index. */
int fw_join(fw_db *db, const char *name, int participant);
int fw_leave(fw_db *db, uint32_t component);
uint32_t fw_n_components(const fw_db *db);
int fw_component_get(const fw_db *db, uint32_t component, fw_component *out);

int fw_schema_add(fw_db *db, const char *text, uint32_t n);          /* same text, same number */
int fw_schema_get(const fw_db *db, uint32_t schema, const char **text, uint32_t *n);  /* text lives with db */

int fw_insert(fw_db *db, const fw_spec *spec);                       /* returns the object's index */
int fw_find(const fw_db *db, const char *name);                      /* returns its index, or -ENOENT */
uint32_t fw_n_objects(const fw_db *db);
int fw_object_get(const fw_db *db, uint32_t object, fw_object *out);

/* -- writing: never waits, makes no system call unless somebody waits ------------------------------------------- */

/* Writes one value; returns its write number. t_data_ns is raised to the newest one if it lies before it. */
int64_t fw_write(fw_db *db, uint32_t object, const void *data, uint32_t n, int64_t t_data_ns,
                 const fw_cause *causes, uint32_t n_causes);
/* The same without a copy: fill the returned slot, then commit. Beginning again abandons what was begun. */
int fw_write_begin(fw_db *db, uint32_t object, void **slot);
int64_t fw_write_commit(fw_db *db, uint32_t object, uint32_t n, int64_t t_data_ns,
                        const fw_cause *causes, uint32_t n_causes);

/* -- reading: never blocks a writer ---------------------------------------------------------------------------- */

/* The write that was visible at a cycle (repeatable), the newest, the newest committed at or before t. */
int64_t fw_visible(const fw_db *db, uint32_t object, uint64_t cycle);
int64_t fw_newest(const fw_db *db, uint32_t object);
int64_t fw_as_of(const fw_db *db, uint32_t object, int64_t t_ns);
/* The write that the latest tick made visible, 0 if that tick changed nothing: for a recorder that keeps up. */
int64_t fw_changed(const fw_db *db, uint32_t object);
/* Copies write number w; returns 0, -EAGAIN (not written yet), -ESTALE (overwritten), -EMSGSIZE. */
int fw_read(const fw_db *db, uint32_t object, uint64_t w, void *buffer, uint32_t capacity, fw_info *info);
/* A view without a copy: valid while fw_check of the same write returns 0. */
int fw_peek(const fw_db *db, uint32_t object, uint64_t w, const void **data, fw_info *info);
int fw_check(const fw_db *db, uint32_t object, uint64_t w);

/* -- clock ------------------------------------------------------------------------------------------------------ */

/* Takes the clock of an attached store whose clock holder died. -EBUSY while it lives. */
int fw_clock_take(fw_db *db);
/* Ends the current cycle: returns the new cycle number, whose cut is complete and visible to all at once. */
int64_t fw_tick(fw_db *db);
uint64_t fw_cycle(const fw_db *db);
int64_t fw_now_ns(const fw_db *db);                                   /* edge time of the current cycle */
/* Waits on the host's clock, at most timeout_ns, until the cycle is larger than `after`; returns the cycle. */
int64_t fw_wait_cycle(fw_db *db, uint64_t after, int64_t timeout_ns);
/* A participant says that it has finished a cycle; the clock's holder waits until all living ones have. */
int fw_done(fw_db *db, uint32_t component, uint64_t cycle);
int fw_wait_done(fw_db *db, uint64_t cycle, int64_t timeout_ns);
/* Waits until the directory has more than n_objects objects. */
int fw_wait_object(fw_db *db, uint32_t n_objects, int64_t timeout_ns);

#ifdef __cplusplus
}
#endif
#endif
