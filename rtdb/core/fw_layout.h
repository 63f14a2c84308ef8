/* fw_layout.h - how a segment is laid out. Private to the core.
 *
 *   offset 0      fw_header      written once, by the creator
 *   directory     fw_directory, then fw_centry[max_components], fw_oentry[max_objects]   under the directory lock
 *   schemas       {u32 length, text, pad to 8} ...                                     under the directory lock
 *   wake          fw_wake, then u32[max_objects]                            writable by everybody: nothing but hints
 *   clock         fw_clock                                                             written by the clock's holder
 *   heap          rings grow up from heap_off, cut logs grow down from the end
 *
 * Regions begin at page boundaries, and in a shared segment so do rings: what a process may write is a set of pages.
 *
 *   ring:   fw_ring, slot[n_slots]                slot: fw_slot, fw_cause[n_causes], payload, pad to 64
 *   cut log: fw_cuts, {cycle, write}[n_slots]     an entry is appended only when the visible write changes
 */
#ifndef FW_LAYOUT_H
#define FW_LAYOUT_H

#include "fw_rtdb.h"
#include "protocol.h"

#define FW_MAGIC 0x3142445452594146ull /* "FAYRTDB1" */
#define FW_PAGE 4096u

typedef struct {
    uint64_t magic;
    uint32_t layout, max_objects, max_components, schema_bytes;
    uint64_t size, store_id;
    int64_t tick_ns, t0_ns;
} fw_header;

typedef struct {
    fw_u32 n_components, n_objects, n_schemas, schema_used;
    fw_u64 next_oid, heap_low, heap_high; /* free heap: [heap_low, heap_high) */
} fw_directory;

typedef struct { char name[FW_NAME_MAX]; int64_t pid; uint32_t participant, pad; } fw_centry;

typedef struct {
    fw_spec spec;
    uint64_t oid, ring_off, cuts_off;
    uint32_t stride, pad;
} fw_oentry;

typedef struct {
    fw_u32 clock, directory, done, pad; /* futex words: bit 0 = somebody waits */
} fw_wake;

/* offsets that follow from the header alone, so that a damaged segment cannot lead a reader astray */
typedef struct { uint64_t directory, components, objects, schemas, wake, wake_done, wake_objects, clock, heap, size; } fw_map;

/* what this process remembers of an object after checking it */
typedef struct {
    fw_ring *ring;
    fw_cuts *cuts;
    uint8_t *slots;
    uint32_t stride, n_slots, size, n_causes, every, phase, component;
    uint64_t begun; /* write number under construction by fw_write_begin, 0 = none */
} fw_ref;

struct fw_db {
    uint8_t *base;
    fw_map map;
    fw_header *header;
    fw_directory *dir;
    fw_centry *components;
    fw_oentry *objects;
    uint8_t *schemas;
    fw_wake *wake;
    fw_u64 *done;
    fw_u32 *object_wake;
    fw_clock *clock;
    fw_ref *refs;         /* [max_objects] */
    uint32_t n_refs;      /* how many of them are filled: 0 .. n_objects */
    uint8_t *owned;       /* [max_components] this process holds the component's lock */
    int fd;               /* -1 = private */
    int creator, has_clock, can_wake;
    uint64_t cuts_mapped; /* shared: cut logs from this offset on are writable here */
    char path[128];
};

/* wait_linux.c: waiting on a 32-bit word. Returns 0, -EAGAIN (the word differs), -ETIMEDOUT, -EINTR. */
int fw_platform_wait(fw_u32 *word, uint32_t seen, int64_t timeout_ns);
void fw_platform_wake(fw_u32 *word);
int64_t fw_platform_monotonic_ns(void);

/* objects.c */
int fw_ref_fill(fw_db *db); /* checks and remembers objects that are new in the directory */
void fw_notify(fw_db *db, fw_u32 *word);
/* segment.c: makes [off, off+n) writable in this process; no-op for private stores */
int fw_writable(fw_db *db, uint64_t off, uint64_t n, int on);
int fw_lock(fw_db *db, int64_t byte, int type);
int fw_lock_held(const fw_db *db, int64_t byte);
#define FW_LOCK_ALIVE 0
#define FW_LOCK_DIRECTORY 1
#define FW_LOCK_CLOCK 2
#define FW_LOCK_COMPONENT 16

#endif
