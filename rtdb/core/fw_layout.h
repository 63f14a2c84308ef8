/* fw_layout.h - how a segment is laid out. Private to the core.
 *
 *   offset 0      fw_header      written once, by the creator
 *   directory     fw_directory, fw_life[max_objects], fw_death[max_objects], u64 name hash[max_objects],
 *                 fw_centry[max_components], fw_oentry[max_objects]                     under the directory lock
 *   schemas       {u32 length, text, pad to 8} ...                                    under the directory lock
 *   wake          fw_wake, u64 done[max_components], u32 wake word[max_objects]         writable by everybody
 *   clock         fw_clock, u64 missed[max_components], life log[max_components]        written by the clock's holder
 *   heap          rings from the low end, cut logs at the high end
 *
 * Regions begin at page boundaries, and in a shared segment so do rings: what a process may write is a set of pages.
 *
 *   ring:     fw_ring, slot[n_slots]              slot: fw_slot, fw_cause[n_causes], payload, pad to 64
 *   cut log:  fw_cuts, fw_cut[n_slots]            an entry is appended only when the visible write changes
 *   life log: fw_cuts, fw_cut[FW_LIVES]           a cut log of 2 = alive, 1 = gone
 *
 * An entry of the directory is in use while its life number is odd. The number is never given twice, and half of it is
 * part of the handle: a handle of an object that is gone names nothing. Which granules of the heap are in use stands in
 * a bit map; it follows from the entries, so that setting it again does no harm.
 *
 * A change of the directory is planned in the intent record, of which `kind` is written last; then it is carried out by
 * steps each of which may be done twice; then `kind` is cleared. Whoever gets the directory lock and finds an intent,
 * carries it out again: its author was killed on the way.
 */
#ifndef FW_LAYOUT_H
#define FW_LAYOUT_H

#include "fw_rtdb.h"
#include "protocol.h"

#define FW_MAGIC 0x3142445452594146ull /* "FAYRTDB1" */
#define FW_PAGE 4096u
#define FW_GRANULES 65536u /* of the heap, at most */
#define FW_LIVES 8u        /* changes of a component's life that are remembered */

typedef struct {
    uint64_t magic;
    uint32_t layout, max_objects, max_components, schema_bytes;
    uint64_t size, store_id;
    int64_t tick_ns, t0_ns, offset_ns; /* offset: store time of a real-time store minus the monotonic clock */
    uint32_t kind, deterministic;
} fw_header;

typedef struct { fw_u64 life, deleted, parent; } fw_life; /* deleted: 1 + the last cycle that shows it, 0 = it lives; parent: if it goes with it */
typedef struct { int64_t t_ns; uint64_t spent_cycle; } fw_death; /* once spent_cycle began, no tick knows of a deleted object any more */

typedef struct {
    fw_spec spec;
    uint64_t life, oid, ring_off, cuts_off;
    int64_t t_insert_ns;
    uint32_t stride, pad;
} fw_oentry;

typedef struct {
    char name[FW_NAME_MAX];
    char version[32];
    int64_t pid;
    uint32_t participant, every, phase, pad;
    uint64_t born_cycle, missed_before; /* a place may have been another's: what came before is not of this name */
} fw_centry;

#define FW_REPLACE (1u << 31) /* flag of fw_insert alone: an object of this name and owner is deleted, if the new one fits */

enum { FW_NOTHING, FW_INSERT, FW_DELETE, FW_FREE };

typedef struct {
    fw_u32 kind;
    uint32_t entry;
    uint64_t version, cycle; /* the directory's version afterwards; FW_DELETE: the last cycle that shows it */
    int64_t t_ns;            /* FW_DELETE: when */
    fw_oentry object;        /* FW_INSERT */
} fw_intent;

typedef struct {
    fw_u32 n_components, n_entries, n_schemas, schema_used;
    fw_u64 next_oid, next_life, heap_low, heap_high, version; /* heap: rings below heap_low, cut logs from heap_high on */
    fw_intent intent;
    fw_u64 used[FW_GRANULES / 64]; /* granules of the heap */
} fw_directory;

typedef struct {
    fw_u32 clock, directory, done, pad; /* words to wait on: see protocol.h */
} fw_wake;

typedef struct {
    fw_edge edge;
    fw_u64 t0_ns, pid, skipped, takeovers;
    fw_u32 lateness_us[FW_BINS];
} fw_clock;

/* offsets that follow from the header alone, so that a damaged segment cannot lead a reader astray */
typedef struct {
    uint64_t directory, life, death, hash, components, objects, schemas, wake, done, object_wake, clock, missed, lives, heap, size;
    uint64_t granule; /* bytes, a power of two */
} fw_map;

/* what this process remembers of an object after checking it */
typedef struct {
    uint64_t life; /* 0 = nothing is remembered */
    fw_ring *ring;
    fw_cuts *cuts;
    uint8_t *slots;
    uint32_t stride, n_slots, size, n_causes, every, phase, component, flags;
    uint64_t due;   /* for the clock: the next tick at which it is due */
    uint64_t begun; /* write number under construction by fw_write_begin, 0 = none */
    int64_t min_cycle_ns, max_age_ns, t_history_ns;
    int public_mapped;
} fw_ref;

/* what this process remembers of a component that it is */
typedef struct {
    uint8_t owned;
    uint32_t every, phase;
    uint64_t begun;      /* the cycle that fw_step began */
    int64_t begun_ns, told_ns; /* host time; store time at which health was written last */
    fw_handle health;
    fw_health state;
} fw_self;

struct fw_db {
    uint8_t *base;
    fw_map map;
    fw_header *header;
    fw_directory *dir;
    fw_life *life;
    fw_death *death;
    fw_u64 *hash;
    fw_centry *components;
    fw_oentry *objects;
    uint8_t *schemas;
    fw_wake *wake;
    fw_u64 *done;
    fw_u32 *object_wake;
    fw_clock *clock;
    fw_u64 *missed;
    uint8_t *lives;
    fw_ref *refs;         /* [max_objects] */
    fw_self *self;        /* [max_components] */
    uint64_t version;     /* of the directory, when the clock's refs were last brought up to date */
    uint32_t n_owned, n_ticked;
    int fd;               /* -1 = private */
    int creator, has_clock, can_wake;
    uint64_t cuts_mapped; /* shared, for the clock: cut logs from this offset on are writable here */
    char path[128];
};

/* wait_linux.c: the only file that knows how this platform waits. */
/* Sleeps while *word is `seen`, at most timeout_ns. Returns 0, -EAGAIN (the word differs), -ETIMEDOUT, -EINTR. */
int fw_platform_wait(fw_u32 *word, uint32_t seen, int64_t timeout_ns);
int64_t fw_platform_monotonic_ns(void);
int64_t fw_platform_unix_ns(void);
/* Sleeps until a time of the monotonic clock. */
void fw_platform_sleep_until(int64_t t_ns);

/* segment.c */
/* Makes [off, off+n) writable in this process, or not; nothing to do for private stores. */
int fw_writable(fw_db *db, uint64_t off, uint64_t n, int on);
/* Writes to memory that is read-only here, through the file: one call instead of opening and closing a page. Not for words
 * that order others. */
int fw_put(fw_db *db, uint64_t off, const void *data, uint64_t n);
/* Locks (F_RDLCK, F_WRLCK) or unlocks one byte: 0, -EBUSY. */
int fw_lock(fw_db *db, int64_t byte, int type);
int fw_lock_held(const fw_db *db, int64_t byte);
#define FW_LOCK_ALIVE 0
#define FW_LOCK_DIRECTORY 1
#define FW_LOCK_CLOCK 2
#define FW_LOCK_MARK 3 /* of the life logs, for who marks the dead without a clock */
#define FW_LOCK_COMPONENT 16
#define FW_LOCK_OBJECT 65552 /* behind the components */

/* directory.c */
int fw_ref_get(const fw_db *db, fw_handle object, fw_ref **out);
int fw_ref_fill(fw_db *db, uint32_t i);
void fw_ring_writable(fw_db *db, const fw_ref *ref, int on);
uint64_t fw_ring_bytes(uint32_t stride, uint32_t n_slots);
int fw_name_ok(const char *name);
int fw_directory_open(fw_db *db);
void fw_directory_close(fw_db *db);
/* Deletes what dead components left, and gives away what nobody uses any more. Under the directory lock. */
void fw_make_room(fw_db *db);
/* objects.c */
int fw_repeatable_only(const fw_db *db);
/* Takes the stamps of the ring from its newest write: who wrote before may have been killed in mid-write. */
void fw_restamp(fw_ref *ref);
/* components.c */
int fw_component_alive(const fw_db *db, uint32_t component);
void fw_health_step(fw_db *db, uint32_t component, uint64_t cycle);
fw_cuts *fw_life_log(const fw_db *db, uint32_t component);
/* wait.c */
/* fw_wait_write, but at most until a host time: then -EAGAIN, and the next call goes on with dead_since_ns (0 at first). */
int64_t fw_wait_write_until(fw_db *db, fw_handle object, uint64_t after, int64_t t_ns, int64_t host_ns, int64_t *dead_since_ns);
/* The host time at which a wait until a store time ends at the latest: whoever ticks a store does not tick while it waits. */
int64_t fw_host_limit(const fw_db *db, int64_t t_ns);
/* Wakes who waits for the word. */
void fw_tell(fw_db *db, fw_u32 *word);
/* Waits for a word until `ready` says so (not 0: it is what is returned) or until a host time. */
int64_t fw_wait_for(fw_db *db, fw_u32 *word, int64_t (*ready)(fw_db *, const void *), const void *what, int64_t deadline_ns);

static inline uint64_t fw_round_up(uint64_t n, uint64_t unit) { return (n + unit - 1) / unit * unit; }
static inline uint32_t fw_index_of(fw_handle h) { return (uint32_t)h; }
static inline fw_handle fw_handle_of(uint64_t life, uint32_t i) { return (fw_handle)((life >> 1) << 32 | i); }
static inline uint32_t fw_bin_of(int64_t ns) {
    uint32_t bin = 0;
    for (int64_t us = ns / 1000; us > 1 && bin < FW_BINS - 1; us >>= 1) bin++;
    return bin;
}

#endif
