/* protocol.h - the lock-free part of the store: write, read, tick, look-up. No system call, no allocation, no loop
 * that another process can prolong. The atomics stand behind macros, so that a model checker compiles the same text.
 *
 * Writing w (one writer per ring)                     | Reading w
 *   1. seq[w % n] = 2w - 1  relaxed   "in progress"   |   1. seq acquire == 2w ?
 *   2. fence release          (with reader 3)         |   2. payload relaxed
 *   3. payload relaxed                                |   3. fence acquire           (with writer 2)
 *   4. fence seq_cst          (with tick 2)           |   4. seq relaxed == 2w ?  then the payload is that of w
 *   5. e = epoch acquire; if new: base = w - 1,       |
 *      then ep = e release                            | Tick c (one clock)
 *   6. seq = 2w release       (with reader 1)         |   1. epoch = c release
 *   7. head = w release       (with tick 3)           |   2. fence seq_cst           (with writer 4)
 *                                                     |   3. each due object: h = head acquire;
 *                                                     |      if ep acquire >= c: h = base
 *                                                     |   4. append (c, h) to its cut log if h is new
 *                                                     |   5. cycle = c release
 * A write that began after step 1 of tick c is not in cut c, whoever saw it: that makes the cut consistent. A plain
 * pass over the heads (step 3 without base) shows effects without their causes; the tests keep that mutant. Where cause and
 * effect have different writers, this needs cumulative seq_cst fences, which C++20 spells out and all machines have.
 *
 * Cut log (one clock appends, anybody searches): entries [tail, head). Before an entry is overwritten, tail moves on
 * and a release fence follows; a reader looks at tail again, behind an acquire fence, after it has read the entry.
 *
 * A writer never overwrites a slot that one of the two newest entries of the cut log names, nor the one that a tick in
 * progress may be about to name (base of the current epoch). It is refused instead, and counted.
 *
 * Waiting for a word (anybody; bit 0: somebody waits)  | Notifying (after the condition was made true)
 *   1. word = (word + 2) | 1  seq_cst  "I wait"        |   1. fence seq_cst             (with wait 1 and 2)
 *   2. fence seq_cst; is the condition true? then go   |   2. bit 0 clear? then nobody waits
 *   3. sleep while the word is what 1 made it          |   3. word += 2                 who announced before does not sleep
 *                                                      |   4. wake all sleepers
 *                                                      |   5. clear bit 0, once, unless somebody announced since 3
 * A notifier that is killed between 3 and 4 leaves bit 0 set: the next one wakes who slept. A waiter that is killed leaves
 * bit 0 set: one notify makes a call for nobody. Only who wants to sleep may have to repeat a step (wait 1).
 *
 * Storage of a deleted object is reused: its life number changes before the first byte does, behind a release fence,
 * and whoever read from a ring looks at the life number again, behind an acquire fence.
 */
#ifndef FW_PROTOCOL_H
#define FW_PROTOCOL_H

#include <errno.h>
#include <stdint.h>
#include <string.h>

#ifndef FW_ATOMICS /* a model checker brings its own */
#include <stdatomic.h>
typedef _Atomic uint64_t fw_u64;
typedef _Atomic uint32_t fw_u32;
#define FW_LOAD(a, order) atomic_load_explicit(&(a), memory_order_##order)
#define FW_STORE(a, v, order) atomic_store_explicit(&(a), (v), memory_order_##order)
#define FW_FENCE(order) atomic_thread_fence(memory_order_##order)
#define FW_FETCH_ADD(a, v) atomic_fetch_add_explicit(&(a), (v), memory_order_seq_cst)
#define FW_EXCHANGE_IF(a, seen, v) atomic_compare_exchange_strong_explicit(&(a), &(seen), (v), memory_order_seq_cst, memory_order_relaxed)
void fw_platform_wake(fw_u32 *word);
#define FW_WAKE(word) fw_platform_wake(word)
#endif

typedef struct { fw_u64 head, ep, base, refused, t_data_ns, t_commit_ns, released, pad; } fw_ring; /* stamps: of the newest write */
typedef struct { fw_u64 seq, t_commit_ns, t_data_ns, size_causes; } fw_slot; /* size | n_causes << 32 | writer << 40 */
typedef struct { fw_u64 cycle, write; } fw_cut;
typedef struct { fw_u64 head, tail, now, before; } fw_cuts; /* now, before: the two newest writes named; fw_cut[n] follow */
typedef struct { fw_u64 epoch, cycle; } fw_edge;

static inline fw_cut *fw_log(fw_cuts *cuts) { return (fw_cut *)(cuts + 1); }

/* Payload copies. Up to 256 bytes go word by word through relaxed atomics, which is formally free of data races.
 * Larger ones (frames) use memcpy: a deliberate race, whose result is thrown away unless seq says that it was none. */
#ifndef FW_WORDWISE_MAX /* the thread sanitizer's build copies everything word by word */
#define FW_WORDWISE_MAX 256u
#endif

static inline void fw_copy_in(void *slot, const void *from, uint32_t n) {
    if (n > FW_WORDWISE_MAX) { memcpy(slot, from, n); return; }
    fw_u64 *to = (fw_u64 *)slot;
    const uint8_t *src = (const uint8_t *)from;
    for (; n >= 8; n -= 8, src += 8) { uint64_t v; memcpy(&v, src, 8); FW_STORE(*to++, v, relaxed); }
    if (n) { uint64_t v = 0; memcpy(&v, src, n); FW_STORE(*to, v, relaxed); }
}

static inline void fw_copy_out(void *to, const void *slot, uint32_t n) {
    if (n > FW_WORDWISE_MAX) { memcpy(to, slot, n); return; }
    fw_u64 *from = (fw_u64 *)(uintptr_t)slot;
    uint8_t *dst = (uint8_t *)to;
    for (; n >= 8; n -= 8, dst += 8) { uint64_t v = FW_LOAD(*from++, relaxed); memcpy(dst, &v, 8); }
    if (n) { uint64_t v = FW_LOAD(*from, relaxed); memcpy(dst, &v, n); }
}

/* May the writer overwrite the slot of write w - n? `now` is read before `before`, and written after it: a `before` of
 * 0 then means that `now` is the first write ever named. Older values of both only make the writer more careful. */
static inline int fw_may_write(fw_ring *ring, fw_cuts *cuts, fw_edge *clock, uint64_t w, uint32_t n) {
    uint64_t epoch = FW_LOAD(clock->epoch, acquire); /* with tick 1 */
    uint64_t now = FW_LOAD(cuts->now, acquire); /* with tick 4 */
    uint64_t keep = FW_LOAD(cuts->before, relaxed);
    if (!keep) keep = now;
    if (!keep && FW_LOAD(ring->ep, relaxed) == epoch) keep = FW_LOAD(ring->base, relaxed);
    return !keep || w < keep + n;
}

static inline void fw_slot_open(fw_slot *slot, uint64_t w) {
    FW_STORE(slot->seq, 2 * w - 1, relaxed);
    FW_FENCE(release); /* with reader 3 */
}

static inline void fw_slot_publish(fw_ring *ring, fw_slot *slot, fw_edge *clock, uint64_t w) {
    FW_FENCE(seq_cst); /* with tick 2 */
    uint64_t epoch = FW_LOAD(clock->epoch, acquire);
    if (epoch != FW_LOAD(ring->ep, relaxed)) {
        FW_STORE(ring->base, w - 1, relaxed);
        FW_STORE(ring->ep, epoch, release); /* with tick 3 */
    }
    FW_STORE(slot->seq, 2 * w, release); /* with reader 1 */
    FW_STORE(ring->head, w, release);    /* with tick 3 */
}

/* 0 when the slot holds w; call before and after reading its content, with the fence in between. */
static inline int fw_slot_check(fw_slot *slot, uint64_t w) {
    uint64_t seq = FW_LOAD(slot->seq, acquire); /* with writer 6 */
    if (seq == 2 * w) return 0;
    return seq < 2 * w ? -EAGAIN : -ESTALE;
}

static inline int fw_slot_still(fw_slot *slot, uint64_t w) {
    FW_FENCE(acquire); /* with writer 2 */
    return FW_LOAD(slot->seq, relaxed) == 2 * w ? 0 : -ESTALE;
}

static inline void fw_tick_begin(fw_edge *clock, uint64_t c) {
    FW_STORE(clock->epoch, c, release);
    FW_FENCE(seq_cst); /* with writer 4 */
}

/* Notes that from cycle c on the log shows `value`. `now` is what it shows so far. */
static inline void fw_cut_append(fw_cuts *cuts, uint32_t n, uint64_t c, uint64_t now, uint64_t value) {
    uint64_t k = FW_LOAD(cuts->head, relaxed);
    if (k >= n) FW_STORE(cuts->tail, k - n + 1, relaxed);
    FW_FENCE(release); /* with look-up 3 */
    FW_STORE(fw_log(cuts)[k % n].cycle, c, relaxed);
    FW_STORE(fw_log(cuts)[k % n].write, value, relaxed);
    FW_STORE(cuts->before, now, relaxed);
    FW_STORE(cuts->now, value, release); /* with fw_may_write */
    FW_STORE(cuts->head, k + 1, release);
}

/* Fixes what cut c shows of one due object. Called again for the same c (a standby finishing the tick of a dead
 * clock) it changes nothing. */
static inline void fw_tick_object(fw_ring *ring, fw_cuts *cuts, uint32_t n, uint64_t c) {
    uint64_t k = FW_LOAD(cuts->head, relaxed);
    if (k && FW_LOAD(fw_log(cuts)[(k - 1) % n].cycle, relaxed) == c) return;
    uint64_t h = FW_LOAD(ring->head, acquire); /* with writer 7 */
#ifndef FW_MUTANT_NAIVE_PASS
    if (FW_LOAD(ring->ep, acquire) >= c) h = FW_LOAD(ring->base, relaxed);
#endif
    uint64_t now = k ? FW_LOAD(fw_log(cuts)[(k - 1) % n].write, relaxed) : 0; /* not cuts->now: a dead clock may be ahead */
    if (h != now) fw_cut_append(cuts, n, c, now, h);
    else if (FW_LOAD(cuts->before, relaxed) != now) FW_STORE(cuts->before, now, relaxed); /* the writer may have the older one's slot */
}

static inline void fw_tick_end(fw_edge *clock, uint64_t c) { FW_STORE(clock->cycle, c, release); }

/* The write that cut c shows, 0 when it shows none yet, -ESTALE when the log no longer reaches back to c. The caller
 * has read cycle >= c with acquire. */
static inline int64_t fw_cut_find(fw_cuts *cuts, uint32_t n, uint64_t c) {
    uint64_t head = FW_LOAD(cuts->head, acquire);
    uint64_t tail = FW_LOAD(cuts->tail, relaxed);
    if (head > tail + n) tail = head - n;
    uint64_t lo = tail, hi = head; /* entries before lo are <= c or gone; entries from hi on are > c */
    uint64_t write = 0;
    if (hi > lo && FW_LOAD(fw_log(cuts)[(hi - 1) % n].cycle, relaxed) <= c) lo = hi - 1; /* the usual question: now */
    while (lo < hi) {
        uint64_t mid = lo + (hi - lo) / 2;
        uint64_t cycle = FW_LOAD(fw_log(cuts)[mid % n].cycle, relaxed);
        uint64_t w = FW_LOAD(fw_log(cuts)[mid % n].write, relaxed);
        if (cycle <= c) { write = w; lo = mid + 1; } else hi = mid;
    }
    FW_FENCE(acquire); /* 3: with the append */
    uint64_t tail_now = FW_LOAD(cuts->tail, relaxed);
    if (lo == tail && tail_now) return -ESTALE;       /* all entries that are left are younger than c */
    if (lo && lo - 1 < tail_now) return -ESTALE;      /* the entry that was found is being overwritten */
    return (int64_t)write;
}

/* The life number of an object's storage: odd while it is an object's, even while it is nobody's. */
static inline void fw_life_end(fw_u64 *life, uint64_t even) {
    FW_STORE(*life, even, relaxed);
    FW_FENCE(release); /* with fw_life_still: no byte of the next object is seen under the old number */
}

/* Called behind the acquire fence of fw_slot_still or fw_cut_find. */
static inline int fw_life_still(fw_u64 *life, uint64_t odd) { return FW_LOAD(*life, relaxed) == odd ? 0 : -EIDRM; }

/* Says that the caller waits for the word; returns what it sleeps on, after a last look at the condition. */
static inline uint32_t fw_announce(fw_u32 *word) {
    uint32_t seen = FW_LOAD(*word, relaxed);
    while (!FW_EXCHANGE_IF(*word, seen, (seen + 2) | 1)) ;
    FW_FENCE(seq_cst); /* with notify 1 */
    return (seen + 2) | 1;
}

/* Tells whoever waits; a fence and a load when nobody does. */
static inline void fw_notify(fw_u32 *word) {
    FW_FENCE(seq_cst); /* with announce */
    if (!(FW_LOAD(*word, relaxed) & 1)) return;
    uint32_t seen = FW_FETCH_ADD(*word, 2) + 2;
    FW_WAKE(word);
    if (seen & 1) (void)FW_EXCHANGE_IF(*word, seen, seen & ~1u);
}

#endif
