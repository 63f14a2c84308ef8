/* fuzz_attach.c - segments are damaged in every way that is thought of, and then used through every public function.
 *
 *   fuzz_attach words   NAME PART PARTS   every word of every table, each with many values; every PARTS-th case from PART on
 *   fuzz_attach random  NAME SEED ROUNDS  random bytes, words and tails
 *   fuzz_attach sizes   NAME              files of every length, and with a header to match
 *   fuzz_attach restore NAME SEED ROUNDS  damaged images of a private store
 *
 * Each case runs in a process that may die: each call must come back, and touch nothing outside of the mapping (which
 * lies between forbidden pages) nor write where this process may not. What it returns is not looked at.
 *
 * Exit status 0: that held. 1: it did not, and lines say with which damage. Others: the program could not do its work.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include "consistency.h"

#define SIZE (160u * 1024)
#define GUARD (16u << 20) /* of forbidden memory before and behind each mapping of the store */
#define CASE_S 20         /* a call that takes longer hangs */
#define MANY 40          /* failures are enough */
#define CYCLES 12

/* -- mappings between forbidden pages: linked with -Wl,--wrap=mmap,--wrap=munmap ------------------------------------- */

void *__real_mmap(void *at, size_t n, int prot, int flags, int fd, off_t off);
int __real_munmap(void *at, size_t n);
void *__wrap_mmap(void *at, size_t n, int prot, int flags, int fd, off_t off);
int __wrap_munmap(void *at, size_t n);

void *__wrap_mmap(void *at, size_t n, int prot, int flags, int fd, off_t off) {
    if (at || n < FW_PAGE) return __real_mmap(at, n, prot, flags, fd, off);
    uint8_t *room = __real_mmap(NULL, n + 2 * GUARD, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (room == MAP_FAILED) return room;
    void *mapped = __real_mmap(room + GUARD, n, prot, flags | MAP_FIXED, fd, off);
    if (mapped == MAP_FAILED) __real_munmap(room, n + 2 * GUARD);
    return mapped;
}

int __wrap_munmap(void *at, size_t n) { return __real_munmap((uint8_t *)at - GUARD, n + 2 * GUARD); }

/* -- a store with something of everything ------------------------------------------------------------------------------- */

static const char *name_;
static uint8_t *whole;   /* its bytes, or those of the image, before the damage */
static size_t whole_n;
static uint8_t *damaged;
static fw_map map_;
static int fd_ = -1;

static void give_up(const char *what, long r) {
    fprintf(stderr, "%s: %ld\n", what, r);
    exit(2);
}

static void path_of(char *path, size_t n, const char *suffix) {
    snprintf(path, n, "/dev/shm/fairway-%u-%s%s", (unsigned)getuid(), name_, suffix);
}

static fw_handle insert(fw_db *db, int component, const char *name, uint32_t flags, uint64_t parent) {
    fw_spec spec = {.size = 40, .n_slots = 5, .every = 1, .component = (uint32_t)component, .flags = flags, .n_causes = 2,
                    .parent = parent, .t_history_ns = 1000000000, .max_age_ns = 1000000000};
    snprintf(spec.name, sizeof spec.name, "%s", name);
    return fw_insert(db, &spec);
}

static const char *const names[] = {"a/plain", "a/parent", "a/child", "a/gone", "b/public", "b/denied", "b/watched", "b/stale",
                                    "b/quiet", "b/persistent"};
static const uint32_t flags_of[] = {0, 0, FW_WITH_PARENT, 0, FW_PUBLIC_WRITE, FW_READ_DENY, FW_CYCLE_WATCH,
                                    FW_WITHHOLD_STALE, FW_NO_NOTIFY, FW_PERSISTENT};
#define N_NAMES (sizeof names / sizeof names[0])

static void populate(fw_db *db) {
    int a = fw_join(db, "a", &(fw_join_opts){.participant = 1, .version = "1.0"}), b = fw_join(db, "b", NULL);
    fw_handle handles[N_NAMES], passing = insert(db, a, "a/passing", FW_IMMEDIATE_DELETE, 0);
    if (fw_schema_add(db, "{\"name\":\"First\"}", 16) < 0 || fw_schema_add(db, "{\"name\":\"Second\"}", 17) < 0)
        give_up("schema", 0);
    for (size_t i = 0; i < N_NAMES; i++) {
        fw_object parent = {0};
        if (flags_of[i] & FW_WITH_PARENT) fw_object_get(db, handles[i - 1], &parent);
        handles[i] = insert(db, names[i][0] == 'a' ? a : b, names[i], flags_of[i], parent.oid);
        if (handles[i] < 0) give_up(names[i], (long)handles[i]);
    }
    fw_object o;
    if (passing < 0 || fw_object_get(db, handles[0], &o) < 0) give_up("passing", (long)passing);
    for (int c = 0; c < CYCLES; c++) {
        uint64_t words[5] = {(uint64_t)c, 1, 2, 3, 4};
        for (size_t i = 0; i < N_NAMES; i++)
            fw_write(db, handles[i], words, sizeof words, c, &(fw_cause){o.oid, (uint64_t)c}, 1);
        if (c == 3) fw_delete(db, passing);
        if (c == 9) fw_delete(db, handles[3]);
        if (fw_tick(db) < 0) give_up("tick", c);
    }
    insert(db, a, "a/late", 0, 0); /* gives the storage of a/passing back */
}

/* An intent of a kind, as if its author had been killed before he began with it. */
enum { SHARED, WITH_INSERT, WITH_DELETE, WITH_FREE, IN_TICK, TEMPLATES };
static const char *const template_names[TEMPLATES] = {"a store", "an insert begun", "a delete begun", "a free begun", "in a tick"};

static fw_directory *directory_in(uint8_t *bytes) { return (fw_directory *)(bytes + map_.directory); }
static fw_oentry *entries_in(uint8_t *bytes) { return (fw_oentry *)(bytes + map_.objects); }

static void begin_change(uint8_t *bytes, int template) {
    fw_intent *t = &directory_in(bytes)->intent;
    t->version = 100;
    t->cycle = CYCLES;
    t->entry = template == WITH_INSERT ? (uint32_t)N_NAMES + 5 : 3;
    if (template == WITH_INSERT) {
        t->object = entries_in(bytes)[5];
        snprintf(t->object.spec.name, FW_NAME_MAX, "a/begun");
        t->object.life = 2001;
        t->object.oid++;
    }
    if (template == WITH_INSERT) FW_STORE(t->kind, FW_INSERT, relaxed);
    if (template == WITH_DELETE) FW_STORE(t->kind, FW_DELETE, relaxed);
    if (template == WITH_FREE) FW_STORE(t->kind, FW_FREE, relaxed);
    if (template == IN_TICK) FW_STORE(((fw_clock *)(bytes + map_.clock))->edge.epoch, CYCLES + 1, relaxed);
}

static void prepare(int private_image) {
    fw_opts opts = {.size = SIZE, .max_objects = 20, .max_components = 4, .schema_bytes = 4096,
                    .clock = private_image ? FW_STEPPED : FW_BARRIER};
    fw_db *db;
    int r = fw_create(&db, private_image ? NULL : name_, &opts);
    if (r == 0) r = fw_clock_take(db);
    if (r < 0) give_up("create", r);
    populate(db);
    map_ = db->map;
    whole_n = private_image ? fw_image_size(db) : SIZE;
    whole = malloc(whole_n);
    damaged = malloc(whole_n);
    if (!whole || !damaged) give_up("malloc", 0);
    if (private_image) fw_save(db, whole, whole_n);
    else memcpy(whole, db->base, whole_n);
    fw_close(db);
    if (private_image) return;
    char path[160];
    path_of(path, sizeof path, "");
    fd_ = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    struct flock lock = {.l_type = F_RDLCK, .l_whence = SEEK_SET, .l_start = FW_LOCK_ALIVE, .l_len = 1};
    if (fd_ < 0 || fcntl(fd_, F_OFD_SETLK, &lock) < 0) give_up("file", errno);
}

/* -- every public function ---------------------------------------------------------------------------------------------- */

static volatile uint64_t sink;
static void touch(const void *data, size_t n) {
    uint64_t sum = 0;
    for (size_t i = 0; i < n; i++) sum += ((const volatile uint8_t *)data)[i];
    sink += sum;
}

static void read_write(fw_db *db, fw_handle h, uint64_t w, uint32_t size) {
    fw_info info;
    const void *data;
    uint8_t *buffer = malloc(size + 1); /* of exactly that size: the sanitizer sees the next byte */
    if (!buffer) give_up("malloc", size);
    if (fw_read(db, h, w, buffer, size, &info) == 0) touch(buffer, info.size);
    if (size && fw_read(db, h, w, buffer, size - 1, &info) == 0) touch(buffer, info.size);
    if (fw_peek(db, h, w, &data, &info) == 0) {
        touch(data, info.size);
        touch(info.causes, sizeof(fw_cause) * info.n_causes);
    }
    fw_check(db, h, w);
    free(buffer);
}

static void read_object(fw_db *db, fw_handle h) {
    const uint64_t c = fw_cycle(db), cycles[] = {0, 1, c - 1, c, c + 1, UINT64_MAX};
    const int64_t times[] = {INT64_MIN, 0, CYCLES * 10000000 / 2, fw_now_ns(db), INT64_MAX};
    fw_object o;
    uint64_t lost;
    if (fw_object_get(db, h, &o) < 0) o = (fw_object){.spec.size = 40};
    else touch(o.spec.name, strlen(o.spec.name));
    int64_t newest = fw_newest(db, h);
    for (size_t i = 0; i < 6; i++) {
        int64_t w = fw_visible(db, h, cycles[i]);
        if (w > 0) read_write(db, h, (uint64_t)w, o.spec.size);
    }
    for (size_t i = 0; i < 5; i++) {
        fw_as_of(db, h, times[i]);
        fw_as_of_data(db, h, times[i]);
        fw_not_before(db, h, times[i]);
    }
    fw_next(db, h, 0, &lost);
    fw_next(db, h, (uint64_t)newest - 1, &lost);
    fw_next(db, h, UINT64_MAX, &lost);
    fw_changed(db, h);
    for (uint64_t w = 0; w < 4; w++) read_write(db, h, (uint64_t)newest - w, o.spec.size);
    read_write(db, h, 1, o.spec.size);
    read_write(db, h, UINT64_MAX, o.spec.size);
}

static void read_all(fw_db *db) {
    uint64_t size, unused, version = fw_directory_version(db);
    fw_component component;
    fw_clock_state clock;
    const char *text;
    uint32_t n;
    fw_memory(db, &size, &unused);
    fw_clock_get(db, &clock);
    sink += (uint64_t)fw_tick_ns(db) + (uint64_t)fw_t0_ns(db) + fw_store_id(db) + version + fw_image_size(db);
    for (uint32_t i = 0; i <= fw_n_components(db); i++) {
        if (fw_component_get(db, i, &component) == 0) touch(component.name, strlen(component.name) + strlen(component.version));
        for (uint64_t back = 0; back < 3; back++) fw_alive_at(db, i, fw_cycle(db) - back);
    }
    for (uint32_t i = 0; i < 20 && fw_schema_get(db, i, &text, &n) == 0; i++) touch(text, n);
    fw_schema_get(db, UINT32_MAX, &text, &n);
    for (uint32_t i = 0; i <= fw_n_entries(db); i++) {
        fw_handle h = fw_entry(db, i);
        if (h >= 0) read_object(db, h);
    }
    for (size_t i = 0; i < N_NAMES; i++) {
        fw_handle h = fw_find(db, names[i]);
        if (h >= 0) sink += (uint64_t)fw_newest(db, h);
    }
    fw_find(db, "");
    fw_find(db, "a name of sixty-three bytes .................................");
    fw_newest(db, (fw_handle)1 << 32 | 1000000);
}

static void wait_all(fw_db *db, int component) {
    fw_wait_cycle(db, fw_cycle(db), 0);
    fw_wait_directory(db, fw_directory_version(db), 0);
    fw_wait_done(db, fw_cycle(db), 0);
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        fw_handle h = fw_entry(db, i);
        if (h >= 0) { fw_wait_write(db, h, 0, INT64_MIN); fw_wait_write(db, h, UINT64_MAX, fw_now_ns(db)); }
    }
    if (component < 0) return;
    fw_done(db, (uint32_t)component, fw_cycle(db));
    fw_step(db, (uint32_t)component, 0);
    fw_status(db, (uint32_t)component, 2, "waiting");
}

static void write_all(fw_db *db) {
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        fw_handle h = fw_entry(db, i);
        fw_object o;
        void *slot;
        if (h < 0 || fw_object_get(db, h, &o) < 0) continue;
        uint8_t *buffer = calloc(1, o.spec.size + 1);
        fw_cause causes[FW_CAUSES_MAX] = {{1, 1}};
        if (!buffer) give_up("malloc", o.spec.size);
        for (uint32_t w = 0; w < o.spec.n_slots && w < 7; w++) {
            int64_t t = fw_not_before(db, h, 0);
            fw_write(db, h, buffer, o.spec.size, t, causes, o.spec.n_causes <= FW_CAUSES_MAX ? o.spec.n_causes : 0);
        }
        fw_write(db, h, buffer, 0, INT64_MAX, NULL, 0);
        if (fw_write_begin(db, h, &slot) == 0) {
            memset(slot, 7, o.spec.size);
            fw_write_commit(db, h, o.spec.size, INT64_MAX, NULL, 0);
        }
        free(buffer);
    }
}

static void change_all(fw_db *db, int component) {
    fw_schema_add(db, "{\"name\":\"Third\"}", 16);
    fw_handle h = insert(db, component, "a/new", 0, 0);
    fw_object o;
    if (h >= 0 && fw_object_get(db, h, &o) == 0) insert(db, component, "a/new/child", FW_WITH_PARENT, o.oid);
    fw_spec huge = {.name = "a/huge", .size = 1u << 30, .n_slots = 4, .every = 1, .component = (uint32_t)component};
    fw_spec long_one = {.name = "a/long", .size = 8, .n_slots = 100, .every = 1, .component = (uint32_t)component};
    fw_insert(db, &huge);
    fw_insert(db, &long_one);
    write_all(db);
}

static void delete_all(fw_db *db) {
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        fw_handle h = fw_entry(db, i);
        if (h >= 0) fw_delete(db, h);
    }
}

static void tick_all(fw_db *db) {
    static const volatile int stop = 1;
    if (fw_clock_take(db) < 0) return;
    for (int i = 0; i < 3; i++) fw_tick(db);
    write_all(db);
    for (int i = 0; i < 3; i++) fw_tick(db);
    fw_mark_dead(db);
    fw_clock_run(db, NULL, 0, &stop);
}

static void use(fw_db *db) {
    read_all(db);
    wait_all(db, -1);
    int a = fw_join(db, "a", NULL), fresh = fw_join(db, "fresh", &(fw_join_opts){.participant = 1, .every = 2, .phase = 1});
    if (a >= 0) {
        write_all(db);
        change_all(db, a);
        wait_all(db, fresh);
    }
    tick_all(db);
    read_all(db);
    fw_db *other;
    if (db->fd >= 0 && fw_attach(&other, name_) == 0) { read_all(other); fw_forget(other); }
    if (fresh >= 0) fw_leave(db, (uint32_t)fresh);
    delete_all(db);
    tick_all(db);
    if (a >= 0) change_all(db, a);
    read_all(db);
}

/* -- cases --------------------------------------------------------------------------------------------------------- */

static struct { volatile uint64_t at, cases; char what[200]; } *now_; /* shared with the process that may die */
static uint64_t random_;

static uint64_t draw(uint64_t n) { /* splitmix64 */
    uint64_t z = random_ += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return (z ^ z >> 31) % n;
}

static void run_attached(uint64_t length) {
    static uint64_t before;
    fw_db *db;
    if (length != before && (ftruncate(fd_, 0) < 0 || ftruncate(fd_, (off_t)length) < 0)) give_up("truncate", errno);
    before = length;
    uint64_t n = length < whole_n ? length : whole_n;
    if (pwrite(fd_, damaged, n, 0) != (ssize_t)n) give_up("write", errno);
    if (fw_attach(&db, name_) < 0) return;
    use(db);
    fw_close(db);
}

/* What a crash left behind is replaced, whatever is in it. */
static void run_replaced(void) {
    char path[160], name[80];
    fw_db *db;
    fw_opts opts = {.size = SIZE, .max_objects = 20, .max_components = 4, .schema_bytes = 4096};
    path_of(path, sizeof path, "-left");
    snprintf(name, sizeof name, "%s-left", name_);
    int left = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    if (left < 0 || write(left, damaged, whole_n) != (ssize_t)whole_n) give_up("file", errno);
    close(left);
    int r = fw_create(&db, name, &opts);
    if (r < 0) { snprintf(now_->what + strlen(now_->what), 60, ": it is not replaced: %d", r); abort(); }
    fw_close(db);
}

static void run_restored(void) {
    fw_opts opts = {.size = SIZE, .max_objects = 20, .max_components = 4, .schema_bytes = 4096};
    fw_db *db;
    if (fw_create(&db, NULL, &opts) < 0) give_up("create", 0);
    memcpy(damaged, db->base, sizeof(fw_header)); /* another store's image is refused at once */
    if (fw_restore(db, damaged, whole_n) == 0) {
        use(db);
        size_t n = fw_image_size(db);
        uint8_t *image = malloc(n);
        if (image && fw_save(db, image, n) == 0) fw_restore(db, image, n);
        free(image);
    }
    fw_close(db);
}

/* Values that are wrong in interesting ways; n of them. The first half replaces the word, the rest a half of it. */
#define VALUES 28u
static uint64_t value_of(uint64_t was, unsigned k) {
    const uint64_t values[] = {0, 1, UINT64_MAX, INT64_MAX, (uint64_t)INT64_MIN, INT32_MAX, SIZE, SIZE - 1, SIZE - 64,
                               map_.heap, map_.heap - 64, map_.directory, was + 1, was - 1, was ^ 1ull << 63, was + 64, was - 64, was * 2};
    const uint32_t small[] = {0, 1, UINT32_MAX, INT32_MAX, 3};
    if (k < 18) return values[k];
    k -= 18;
    return k < 5 ? (was & ~(uint64_t)UINT32_MAX) | small[k] : (was & UINT32_MAX) | (uint64_t)small[k - 5] << 32;
}

/* The beginning of a ring with its first slot, or of a cut log with its first entries. */
static int begins_storage(uint64_t off) {
    for (uint32_t i = 0; i < FW_LOAD(directory_in(whole)->n_entries, relaxed); i++) {
        const fw_oentry *e = &entries_in(whole)[i];
        if (off - e->ring_off < sizeof(fw_ring) + 64 || off - e->cuts_off < sizeof(fw_cuts) + 2 * sizeof(fw_cut)) return 1;
    }
    return 0;
}

/* Words that are looked at: tables whole, of long rows of the same a part. */
static int is_interesting(uint64_t off, int template) {
    uint64_t used = map_.directory + offsetof(fw_directory, used), intent = map_.directory + offsetof(fw_directory, intent);
    if (template != SHARED && template != IN_TICK)
        return (off >= intent && off < intent + sizeof(fw_intent)) ||
               (off >= map_.objects + 3 * sizeof(fw_oentry) && off < map_.objects + 4 * sizeof(fw_oentry));
    if (template == IN_TICK) return off >= map_.clock && off < map_.heap;
    if (off < sizeof(fw_header)) return 1;
    if (off < map_.directory) return 0;
    if (off >= used && off < used + sizeof(((fw_directory *)0)->used)) return off < used + 64 || off % 512 == 0;
    if (off >= used && off < map_.life) return 0;
    if (off >= map_.schemas + 64 && off < map_.wake) return off % 512 == 0;
    if (off < map_.heap) return off < map_.object_wake + 80 || (off >= map_.clock && off < map_.lives + 400);
    uint64_t word;
    memcpy(&word, whole + off, 8);
    return word != 0 || begins_storage(off) || off % 512 == 0;
}

/* Each mode runs its cases from number `from` on, and leaves in now_->at the one that it is at. */
static uint64_t part, parts, rounds, seed_;

static int begin_case(uint64_t from) { /* 0: it is another's */
    uint64_t at = ++now_->at;
    if (at <= from || at % parts != part % parts) return 0;
    now_->cases++;
    alarm(CASE_S);
    return 1;
}

static void run_words(uint64_t from) {
    for (int template = 0; template < TEMPLATES; template++)
        for (uint64_t off = 0; off < whole_n; off += 8) {
            if (!is_interesting(off, template)) continue;
            for (unsigned k = 0; k < VALUES; k++) {
                uint64_t word;
                if (!begin_case(from)) continue;
                memcpy(damaged, whole, whole_n);
                begin_change(damaged, template);
                memcpy(&word, damaged + off, 8);
                word = value_of(word, k);
                memcpy(damaged + off, &word, 8);
                snprintf(now_->what, sizeof now_->what, "%s, word %#lx = %#lx", template_names[template], (unsigned long)off,
                         (unsigned long)word);
                run_attached(whole_n);
            }
        }
}

/* One to eight damages of a random sort; the case is given by its seed alone. */
static void damage(uint64_t seed) {
    int template = (int)((random_ = seed), draw(TEMPLATES));
    memcpy(damaged, whole, whole_n);
    if (fd_ >= 0) begin_change(damaged, template);
    uint64_t limit = draw(4) ? map_.heap : whole_n;
    for (uint64_t i = 0, n = 1 + draw(8); i < n; i++) {
        uint64_t off = draw(limit / 8) * 8, word = 0, last = draw(4);
        while (last && draw(8) && !word) { /* mostly words that hold something */
            off = draw(limit / 8) * 8;
            memcpy(&word, whole + off, 8);
        }
        memcpy(&word, damaged + off, 8);
        switch (draw(4)) {
        case 0: word = draw(UINT64_MAX); break;
        case 1: word ^= 1ull << draw(64); break;
        case 2: word = (word & ~(0xffull << 8 * last)) | draw(256) << 8 * last; break;
        default: word = value_of(word, (unsigned)draw(VALUES));
        }
        memcpy(damaged + off, &word, 8);
    }
    snprintf(now_->what, sizeof now_->what, "random damage of seed %lu", (unsigned long)seed);
}

static void run_random(uint64_t from) {
    for (uint64_t seed = seed_; seed < seed_ + rounds; seed++) {
        if (!begin_case(from)) continue;
        damage(seed);
        if (fd_ < 0) run_restored();
        else if (seed % 50 == 0) run_replaced();
        else run_attached(whole_n);
    }
}

static void run_sizes(uint64_t from) {
    fw_header *h = (fw_header *)damaged;
    for (uint64_t length = 0; length <= whole_n; length = length < 256 ? length + 1 : length + 512)
        if (begin_case(from)) {
            memcpy(damaged, whole, whole_n);
            snprintf(now_->what, sizeof now_->what, "cut off at %lu", (unsigned long)length);
            run_attached(length);
        }
    for (uint64_t length = FW_PAGE; length <= 2 * whole_n; length += FW_PAGE) /* the header says the length that the file has */
        if (begin_case(from)) {
            memcpy(damaged, whole, whole_n);
            h->size = length;
            snprintf(now_->what, sizeof now_->what, "a header for %lu bytes", (unsigned long)length);
            run_attached(length);
        }
    for (uint32_t n = 1; n < 400; n++) /* tables of other lengths: everything behind them is something else */
        if (begin_case(from)) {
            memcpy(damaged, whole, whole_n);
            if (n % 3 == 0) h->max_objects = n;
            else if (n % 3 == 1) h->max_components = n;
            else h->schema_bytes = 8 * n;
            snprintf(now_->what, sizeof now_->what, "tables of other lengths: %u", n);
            run_attached(whole_n);
        }
    for (unsigned k = 0; k < 3; k++)
        if (begin_case(from)) {
            random_ = k;
            for (size_t i = 0; i < whole_n; i++) damaged[i] = k == 0 ? 0 : k == 1 ? 0xff : (uint8_t)draw(256);
            snprintf(now_->what, sizeof now_->what, "junk %u", k);
            run_attached(whole_n);
        }
}

/* Runs the cases in a process that may die; when it did, in another one from the next case on. */
static int run(void (*mode)(uint64_t)) {
    uint64_t from = 0;
    int failures = 0;
    for (;; failures++) {
        int status;
        now_->at = 0;
        fflush(stdout);
        pid_t child = fork();
        if (child < 0) give_up("fork", errno);
        if (child == 0) {
            prctl(PR_SET_PDEATHSIG, SIGKILL);
            mode(from);
            _exit(0);
        }
        waitpid(child, &status, 0);
        if (WIFEXITED(status) && WEXITSTATUS(status) == 0) return failures;
        printf("case %lu: %s: ", (unsigned long)now_->at, now_->what);
        if (WIFEXITED(status)) printf("exit %d\n", WEXITSTATUS(status));
        else printf("signal %d%s\n", WTERMSIG(status), WTERMSIG(status) == SIGALRM ? ": it hangs" : "");
        if (now_->at <= from || failures == MANY) return failures + 1;
        from = now_->at;
    }
}

int main(int argc, char **argv) {
    static const struct { const char *name; int argc; void (*run)(uint64_t); } modes[] = {
        {"words", 5, run_words}, {"random", 5, run_random}, {"sizes", 3, run_sizes}, {"restore", 5, run_random}};
    size_t mode = 0;
    while (mode < 4 && (argc < 3 || strcmp(argv[1], modes[mode].name) != 0 || argc != modes[mode].argc)) mode++;
    if (mode == 4) {
        fprintf(stderr, "usage: fuzz_attach words NAME PART PARTS | random|restore NAME SEED ROUNDS | sizes NAME\n");
        return 2;
    }
    name_ = argv[2];
    part = argc == 5 ? strtoull(argv[3], NULL, 10) : 0;
    parts = mode == 0 ? strtoull(argv[4], NULL, 10) : 1;
    rounds = argc == 5 ? strtoull(argv[4], NULL, 10) : 0;
    now_ = __real_mmap(NULL, FW_PAGE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (now_ == MAP_FAILED || !parts) give_up("mmap", errno);
    seed_ = part;
    part = mode == 0 ? part : 0;
    prepare(mode == 3);
    int failures = run(modes[mode].run);
    char path[160];
    for (int i = 0; i < 2 && fd_ >= 0; i++) {
        path_of(path, sizeof path, i ? "-left" : "");
        unlink(path);
    }
    printf("cases %lu failures %d\n", (unsigned long)now_->cases, failures);
    return failures != 0;
}
