/* fw_rtdb.h - the Fairway real-time database: public C interface, and its manual.
 *
 * One segment of memory holds objects. An object is a ring of slots; one component (its owner) writes it, anybody
 * reads it. What was written becomes visible at clock edges: tick c fixes, for every object that is due at c, which
 * write its readers see, and the choices of one tick form a consistent cut (no effect without its cause).
 *
 *   segment   | header | directory | schemas | wake words, done counters | clock | heap: rings ->      <- cut logs |
 *             |  read-only for readers       | writable for all attached | clock's holder | each owner's | clock's |
 *
 * The segment is a file in /dev/shm shared by processes, or private memory of one process: the same code.
 *
 * Failure: every function that can fail returns a negative errno value. Nothing is changed by a call that fails.
 *   -EAGAIN     nothing is there yet (no write, not visible at that cycle)
 *   -ESTALE     it was there and aged out of the history
 *   -EDOM       the cycle lies in the future
 *   -EIDRM      the object was deleted (its history stays readable for its time)
 *   -ETIME      withheld: the value is older than the object allows (FW_WITHHOLD_STALE)
 *   -EACCES     not readable for others (FW_READ_DENY)
 *   -EOPNOTSUPP not repeatable, and so refused to the components of a deterministic store
 *   -EBUSY      held by another process (name, component, clock); or a writer is too fast: its next slot is still
 *               named by one of the two newest cuts, or the last write is less than min_cycle_ns ago (FW_CYCLE_WATCH)
 *   -ERANGE     data time goes backward
 *   -EPERM      the caller does not own what it wants to write or delete, or holds no clock
 *   -ENOENT     no such store, component or object       -EEXIST  the name is taken
 *   -EPROTO     not a store, damaged, or made by another layout
 *   -EOWNERDEAD what a crash left of a store             -EHOSTDOWN  nobody ticks this store
 *   -EMSGSIZE   larger than the object's slots           -ENOSPC  the segment, or one of its tables, is full
 *   -EINVAL     an argument out of range                 -ETIMEDOUT  -EINTR (a signal came while waiting)
 *
 * Threads: one fw_db belongs to one thread at a time. Processes: any number. Killing a process at any instruction
 * blocks nobody: locks are kernel file locks (released by the kernel), data is never locked. A forked child calls
 * fw_forget and attaches anew.
 *
 * Times are signed 64-bit nanoseconds since 1970. Store time is the edge time of the current cycle in a stepped or a
 * barrier store, and the host's monotonic time plus an offset fixed at the store's creation in a real-time one.
 */
#ifndef FW_RTDB_H
#define FW_RTDB_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define FW_LAYOUT 2u        /* changes with every change of the layout in fw_layout.h */
#define FW_NAME_MAX 64u     /* bytes of a name with its final NUL */
#define FW_CAUSES_MAX 8u    /* writes that one write may name as its causes */
#define FW_BINS 20u         /* of a histogram: bin k counts times from 2^k to 2^(k+1) us, the first and last what is beyond */

typedef struct fw_db fw_db;

/* A handle: names one object for as long as this process is attached. Handles of deleted objects fail with -EIDRM and
 * never come to mean another object. */
typedef int64_t fw_handle;

/* Who ends the cycles. */
enum {
    FW_STEPPED = 0,  /* whoever holds the clock calls fw_tick */
    FW_BARRIER = 1,  /* fw_clock_run ticks as soon as all participants are done */
    FW_REAL = 2,     /* fw_clock_run ticks at absolute times of the host's monotonic clock */
};

/* What fw_create needs. Zero means the default in brackets. */
typedef struct {
    uint64_t size;            /* bytes of the segment [4 MiB] */
    uint32_t max_objects;     /* [256] */
    uint32_t max_components;  /* [64] */
    uint32_t schema_bytes;    /* room for schemas [256 KiB] */
    uint32_t clock;           /* FW_STEPPED, FW_BARRIER, FW_REAL */
    int64_t tick_ns;          /* base tick [10 ms] */
    int64_t t0_ns;            /* time of cycle 0; a real-time store takes the time at which its clock starts */
    uint32_t deterministic;   /* refuse to components what is not repeatable */
} fw_opts;

/* Flags of an object. */
enum {
    FW_HOST_DEPENDENT = 1,    /* differs from run to run: not part of the trace (kept for the caller) */
    FW_STATIC = 2,            /* written once; its age says nothing (kept for the caller) */
    FW_READ_DENY = 4,         /* only the owner's process reads it */
    FW_PUBLIC_WRITE = 8,      /* anybody may write and delete it, under a kernel lock for each write */
    FW_PERSISTENT = 16,       /* its storage is not given to others when its component is gone and room is needed */
    FW_IMMEDIATE_DELETE = 32, /* no history after its deletion */
    FW_CYCLE_WATCH = 64,      /* refuse writes sooner than min_cycle_ns after the one before */
    FW_WITHHOLD_STALE = 128,  /* refuse reads of what was committed more than max_age_ns before */
    FW_NO_NOTIFY = 256,       /* writes never make a system call; who waits for one looks every min_cycle_ns / 10 */
    FW_WITH_PARENT = 512,     /* deleted when its parent is */
};

/* What fw_insert needs. */
typedef struct {
    char name[FW_NAME_MAX];   /* "component/object" */
    uint32_t schema;          /* from fw_schema_add */
    uint32_t size;            /* largest payload, bytes */
    uint32_t n_slots;         /* at least 4: two cuts, the newest write, the one under construction */
    uint32_t every, phase;    /* due at ticks c with c % every == phase */
    uint32_t flags;
    uint32_t n_causes;        /* room for causes in each slot, at most FW_CAUSES_MAX */
    uint32_t component;       /* owner, from fw_join */
    uint64_t parent;          /* object id, 0 = none */
    int64_t t_history_ns;     /* how long the history stays readable after deletion [0: n_slots * every * tick] */
    int64_t min_cycle_ns;     /* for FW_CYCLE_WATCH and FW_NO_NOTIFY [0: every * tick] */
    int64_t max_age_ns;       /* for FW_WITHHOLD_STALE */
} fw_spec;

typedef struct {
    fw_spec spec;
    uint64_t oid;             /* never reused, also not by a later store of that name */
    uint64_t head;            /* newest write number */
    uint64_t refused;         /* writes refused as too fast */
    int64_t t_data_ns;        /* of the newest write */
    int64_t t_insert_ns;
    int64_t t_delete_ns;      /* INT64_MAX while it lives */
    uint64_t deleted_cycle;   /* the last cycle that shows it, UINT64_MAX while it lives */
} fw_object;

/* What fw_join needs besides the name. */
typedef struct {
    const char *version;      /* of the program, at most 31 bytes; NULL = "" */
    uint32_t participant;     /* the barrier waits for it, the real clock counts what it misses */
    uint32_t every, phase;    /* due at cycles c with c % every == phase [1, 0] */
} fw_join_opts;

typedef struct {
    char name[FW_NAME_MAX];
    char version[32];
    int64_t pid;              /* of the latest owner */
    int alive;                /* its lock is held */
    int participant;
    uint32_t every, phase;
    uint64_t done;            /* newest cycle it reported done */
    uint64_t missed;          /* due cycles that ended without it, counted by the real clock */
} fw_component;

/* The payload of the object "<component>/health", which fw_join inserts in shared stores: a record like any other. */
typedef struct {
    int64_t pid;
    uint64_t steps;           /* cycles done */
    uint64_t missed;
    uint32_t run_us[FW_BINS];      /* from fw_step to fw_done */
    uint32_t lateness_us[FW_BINS]; /* from the edge to the return of fw_step; real-time stores only */
    uint8_t state;            /* 0 unknown, 1 running, 2 waiting, 3 warning, 4 failure */
    char version[31];
    char status[160];         /* text */
} fw_health;

typedef struct { uint64_t oid, write; } fw_cause;

typedef struct {
    uint64_t write;           /* write number, 1, 2, 3, ... per object */
    int64_t t_commit_ns;      /* store time at which it was written */
    int64_t t_data_ns;        /* when what it tells was true; never decreases per object */
    uint32_t size;
    uint32_t writer;          /* component that wrote it */
    uint32_t n_causes;
    fw_cause causes[FW_CAUSES_MAX];
} fw_info;

typedef struct {
    uint32_t kind;            /* FW_STEPPED, ... */
    int alive;                /* somebody holds the clock */
    int64_t pid;              /* who did last */
    uint64_t cycle;
    uint64_t skipped;         /* ticks that a late real-time clock left out */
    uint64_t takeovers;       /* how often a clock was taken over */
    int64_t late_ns;          /* real-time: how long the next tick is overdue; a stalled clock shows here */
    uint32_t lateness_us[FW_BINS]; /* of its ticks */
} fw_clock_state;

/* -- stores -------------------------------------------------------------------------------------------------- */

/* Makes a store: private memory when name is NULL (stepped only), else a segment that others can attach. -EBUSY if a
 * living process has a store of that name; a store that a crash left behind is replaced. The creator holds the clock
 * of a stepped store; the others wait for fw_clock_run. */
int fw_create(fw_db **out, const char *name, const fw_opts *opts);
/* Attaches to a store. -ENOENT, -EOWNERDEAD, -EPROTO. Only what this process comes to own is mapped writable. Notes
 * who died if no clock does. */
int fw_attach(fw_db **out, const char *name);
/* Gives everything back; the creator also removes the name. */
void fw_close(fw_db *db);
/* 1 while the store's name means this store: it was not removed by its creator, nor replaced; 0 for a private one. */
int fw_bears_name(const fw_db *db);
/* For a forked child: lets go of memory and file without a trace, and never touches the parent's locks. */
void fw_forget(fw_db *db);
int64_t fw_tick_ns(const fw_db *db);
int64_t fw_t0_ns(const fw_db *db);
uint64_t fw_store_id(const fw_db *db);
/* Bytes of the heap, and how many of them no object has. */
void fw_memory(const fw_db *db, uint64_t *size, uint64_t *unused);
/* Copies a private store to and from a buffer of fw_image_size bytes (0: not a private store). */
size_t fw_image_size(const fw_db *db);
int fw_save(const fw_db *db, void *image, size_t n);
int fw_restore(fw_db *db, const void *image, size_t n);

/* -- components ------------------------------------------------------------------------------------------------ */

/* Becomes the component `name`, new or left behind by a dead process, whose objects it takes over. -EBUSY if it
 * lives. Returns its index. */
int fw_join(fw_db *db, const char *name, const fw_join_opts *opts);
/* Stops being it; its objects stay readable, and wait for a successor until their storage is needed. */
int fw_leave(fw_db *db, uint32_t component);
uint32_t fw_n_components(const fw_db *db);
int fw_component_get(const fw_db *db, uint32_t component, fw_component *out);
/* 1 if the component lived at the tick that began a cycle, 0 if not. Repeatable, but for the current cycle of a store that
 * nobody ticks: fw_mark_dead may still note a death there. -EDOM, -ESTALE. */
int fw_alive_at(const fw_db *db, uint32_t component, uint64_t cycle);
/* Says how a component is, in its health object. Shared stores only; elsewhere it does nothing. */
int fw_status(fw_db *db, uint32_t component, uint8_t state, const char *text);

/* -- schemas and objects --------------------------------------------------------------------------------------- */

int fw_schema_add(fw_db *db, const char *text, uint32_t n);          /* same text, same number */
int fw_schema_get(const fw_db *db, uint32_t schema, const char **text, uint32_t *n);  /* text lives with db */

/* Returns the object's handle. -EIDRM: its parent is not there (any more). Without room, what dead components left and
 * nobody took over is deleted (never what is FW_PERSISTENT); its storage is there behind the next tick. */
fw_handle fw_insert(fw_db *db, const fw_spec *spec);
/* Deletes an object, and those that were inserted with FW_WITH_PARENT below it. Its history stays readable for
 * t_history_ns, waiters wake with -EIDRM, the name is free at once. For its owner; for anybody if it is public or its
 * component is gone. */
int fw_delete(fw_db *db, fw_handle object);
fw_handle fw_find(const fw_db *db, const char *name);                /* the living object of that name, or -ENOENT */
/* Walks the directory: i from 0 up to fw_n_entries. The object in entry i, dead ones too as long as their history is
 * there; -ENOENT for an empty entry. */
uint32_t fw_n_entries(const fw_db *db);
fw_handle fw_entry(const fw_db *db, uint32_t i);
int fw_object_get(const fw_db *db, fw_handle object, fw_object *out);
/* Grows with every insert and delete. */
uint64_t fw_directory_version(const fw_db *db);

/* -- writing: never waits, makes no system call unless somebody waits (or FW_PUBLIC_WRITE asks for its lock) ------ */

/* Writes one value; returns its write number. For what is computed from other values, t_data_ns is the oldest of theirs,
 * raised to what fw_not_before says. */
int64_t fw_write(fw_db *db, fw_handle object, const void *data, uint32_t n, int64_t t_data_ns,
                 const fw_cause *causes, uint32_t n_causes);
int64_t fw_not_before(fw_db *db, fw_handle object, int64_t t_data_ns); /* the time, or that of the newest write if later */
/* The same without a copy: fill the returned slot, then commit. Beginning again abandons what was begun. Not for public
 * objects (-EPERM). */
int fw_write_begin(fw_db *db, fw_handle object, void **slot);
int64_t fw_write_commit(fw_db *db, fw_handle object, uint32_t n, int64_t t_data_ns,
                        const fw_cause *causes, uint32_t n_causes);

/* -- reading: never blocks a writer ---------------------------------------------------------------------------- */

/* The write that was visible at a cycle (repeatable). -EAGAIN or 0: none yet. */
int64_t fw_visible(const fw_db *db, fw_handle object, uint64_t cycle);
/* The newest write; the newest one committed at or before t; the newest one whose data time is at or before t. Not
 * repeatable while the writer runs. */
int64_t fw_newest(const fw_db *db, fw_handle object);
int64_t fw_as_of(const fw_db *db, fw_handle object, int64_t t_ns);
int64_t fw_as_of_data(const fw_db *db, fw_handle object, int64_t t_ns);
/* The next write after `after` that is still there, with the exact number of those in between that are not. */
int64_t fw_next(const fw_db *db, fw_handle object, uint64_t after, uint64_t *lost);
/* The write that the latest tick made visible, 0 if that tick changed nothing: for a recorder that keeps up. */
int64_t fw_changed(const fw_db *db, fw_handle object);
/* Copies write number w; returns 0, -EAGAIN (not written yet), -ESTALE (overwritten), -EMSGSIZE. */
int fw_read(const fw_db *db, fw_handle object, uint64_t w, void *buffer, uint32_t capacity, fw_info *info);
/* A view without a copy: what was read through it counts only if fw_check of the same write returns 0 afterwards. A
 * write that one of the two newest cuts names is not overwritten. */
int fw_peek(const fw_db *db, fw_handle object, uint64_t w, const void **data, fw_info *info);
int fw_check(const fw_db *db, fw_handle object, uint64_t w);

/* -- waiting ---------------------------------------------------------------------------------------------------- */

/* Waits until there is a write after `after`, at most until the store time is t_ns; returns the newest one.
 * -ETIMEDOUT; -EIDRM when it is deleted; -EHOSTDOWN when a stepped or barrier store is without a clock for 200 ms (a
 * standby needs less). Whoever ticks the store waits by the host's time: store time stands meanwhile. */
int64_t fw_wait_write(fw_db *db, fw_handle object, uint64_t after, int64_t t_ns);
/* Waits, at most timeout_ns of the host's time, until the cycle is larger than `after`; returns the cycle. */
int64_t fw_wait_cycle(fw_db *db, uint64_t after, int64_t timeout_ns);
/* Waits, at most timeout_ns of the host's time, until the directory's version is not `seen`. */
int fw_wait_directory(fw_db *db, uint64_t seen, int64_t timeout_ns);

/* -- clock ------------------------------------------------------------------------------------------------------ */

uint64_t fw_cycle(const fw_db *db);
/* Store time: see above. */
int64_t fw_now_ns(const fw_db *db);
void fw_clock_get(const fw_db *db, fw_clock_state *out);
/* Takes the clock of a store whose clock holder is gone. -EBUSY while it lives. */
int fw_clock_take(fw_db *db);
/* Ends the current cycle: returns the new cycle number, whose cut is complete and visible to all at once. A tick that
 * a dead clock left half done is finished first. */
int64_t fw_tick(fw_db *db);
/* Ticks a barrier or a real-time store until *stop is not 0. Takes the clock first, waiting for it as a standby while
 * another holds it. Tick 1 waits until each component in `wait_for` (n names) has joined. Real time:
 * absolute deadlines, so that no lateness adds up; a clock that is late by more than a tick leaves ticks out, and
 * counts them. Returns 0, or a negative errno value. */
int fw_clock_run(fw_db *db, const char *const *wait_for, uint32_t n, const volatile int *stop);
/* The same in a thread of its own, attached on its own. */
typedef struct fw_clock_thread fw_clock_thread;
int fw_clock_start(fw_clock_thread **out, const char *name, const char *const *wait_for, uint32_t n);
/* Ends the thread; returns what fw_clock_run returned. */
int fw_clock_stop(fw_clock_thread *clock);
/* For a forked child, in which the thread does not run: see fw_forget. */
void fw_clock_forget(fw_clock_thread *clock);
/* Cycles as a file descriptor, for poll(2): it becomes readable as each cycle after `after` begins, and stays so until
 * everything was read from it; how much that is says nothing. A thread of its own hears of the cycles, attached on its
 * own, without signals. */
typedef struct fw_edges fw_edges;
int fw_edges_start(fw_edges **out, const char *name, uint64_t after);
/* The descriptor, which does not block; it is open until the stop. */
int fw_edges_fd(const fw_edges *edges);
/* Ends the thread and closes the descriptor. */
void fw_edges_stop(fw_edges *edges);
/* For a forked child, in which the thread does not run: see fw_forget. */
void fw_edges_forget(fw_edges *edges);
/* Notes, for fw_alive_at and for waiters, who died since the last tick: for stores that nobody ticks at the moment.
 * -EBUSY when somebody does. */
int fw_mark_dead(fw_db *db);

/* A participant says that it has finished a cycle. */
int fw_done(fw_db *db, uint32_t component, uint64_t cycle);
/* Waits until all living participants that were due have finished; for whoever ticks. */
int fw_wait_done(fw_db *db, uint64_t cycle, int64_t timeout_ns);
/* A component's own pace: waits for its next due cycle after the one it last began, and returns it. */
int64_t fw_step(fw_db *db, uint32_t component, int64_t timeout_ns);

#ifdef __cplusplus
}
#endif
#endif
