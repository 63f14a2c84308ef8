/* kill_steps.c - a process is killed at each step of one operation; others then go on with what it left.
 *
 *   kill_steps steps  NAME   dies at the n-th STEP() of the core, for n = 1, 2, 3, ... until the operation survives;
 *                            the core is compiled with -DFW_TEST_KILLS
 *   kill_steps stores NAME   single-steps the operation, and copies the segment after each instruction that changed it:
 *                            each copy is what a kill at that instruction leaves (of long rows of marks in the heap's
 *                            bit map, every 16th is looked at)
 *
 * After each kill another process reads, changes the directory, takes the dead one's component over, ticks, and in the
 * end deletes everything: every object is wholly there or wholly gone, all others are as they were, no byte is lost.
 *
 * Exit status 0: all of that held; a line per operation says how many kills. 1: it did not, and lines say what. 3: this
 * machine forbids tracing. Others: the program could not do its work.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/wait.h>
#include <unistd.h>

#include "consistency.h"

#define CYCLES 5u          /* of history before the operation: in cycle first_ + c, write c of cause and effect is visible */
#define COMPONENTS 8u
#define KILLS_MAX 100000   /* of one operation, and a bound for every loop below */
#define STEPS_MAX 20000000 /* instructions of one operation */
#define HUGE_SIZE (1u << 30)
#define MANY 5             /* failures of one operation are enough */

static const char *name_; /* of the store */
static char copy_[64];
static fw_db *maker;      /* keeps the store alive; neither ticks nor writes */
static int copy_fd = -1, failures;
static volatile sig_atomic_t armed;
static long countdown;
static volatile int *phase; /* shared with the child: 1 while the operation runs, 2 behind it */
static char where[128];
static uint64_t first_;

void fw_test_step(void);
void fw_test_step(void) {
    if (armed && --countdown == 0) kill(getpid(), SIGKILL);
}

static void broken(const char *what, const char *about, long x, long y) {
    printf("%s: %s (%s %ld %ld)\n", where, what, about, x, y);
    failures++;
}

static void give_up(const char *what, long r) {
    fprintf(stderr, "%s: %s: %ld\n", where, what, r);
    if (maker) fw_close(maker);
    exit(2);
}

/* -- the store before the operation -------------------------------------------------------------------------------- */

static uint64_t word_of(uint64_t write) { return write * 0x9e3779b97f4a7c15u; }

static int64_t write_next(fw_db *db, fw_handle h, const fw_cause *cause) {
    fw_object o;
    uint64_t words[4];
    int r = fw_object_get(db, h, &o);
    if (r < 0) return r;
    for (int i = 0; i < 4; i++) words[i] = word_of(o.head + 1);
    return fw_write(db, h, words, sizeof words, (int64_t)o.head, cause, cause ? 1 : 0);
}

static fw_handle insert(fw_db *db, int component, const char *name, fw_handle parent, uint32_t flags, uint32_t size) {
    fw_object above = {0};
    if (parent >= 0 && fw_object_get(db, parent, &above) < 0) return -EINVAL;
    fw_spec spec = {.size = size, .n_slots = 8, .every = 1, .component = (uint32_t)component, .parent = above.oid,
                    .flags = flags | (parent >= 0 ? FW_WITH_PARENT : 0), .n_causes = 1, .t_history_ns = 1};
    snprintf(spec.name, sizeof spec.name, "%s", name);
    return fw_insert(db, &spec);
}

static void must(const char *what, int64_t r) {
    if (r < 0) give_up(what, (long)r);
}

static void write_pair(fw_db *db, fw_handle cause, fw_handle effect) {
    fw_object o;
    must("cause", write_next(db, cause, NULL));
    must("object", fw_object_get(db, cause, &o));
    must("effect", write_next(db, effect, &(fw_cause){o.oid, o.head}));
}

/* Fills the table of components with some that are gone and have nothing: their places are given to others. */
static void crowd(fw_db *db) {
    for (uint32_t i = fw_n_components(db); i < COMPONENTS; i++) {
        char name[32];
        snprintf(name, sizeof name, "idle%u", i);
        int c = fw_join(db, name, NULL);
        must(name, c);
        must("health", fw_delete(db, db->self[c].health));
        must("leave", fw_leave(db, (uint32_t)c));
    }
    for (int i = 0; i < 20; i++) must("tick", fw_tick(db));
}

static void prepare_store(int crowded) {
    fw_opts opts = {.size = 160 * 1024, .max_objects = 32, .max_components = COMPONENTS, .schema_bytes = 4096,
                    .clock = FW_BARRIER};
    must("create", fw_create(&maker, name_, &opts));
    fw_db *db;
    must("attach", fw_attach(&db, name_));
    must("clock", fw_clock_take(db));
    int keeper = fw_join(db, "keeper", NULL), subject = fw_join(db, "subject", NULL), ghost = fw_join(db, "ghost", NULL);
    must("join", keeper < subject ? keeper : subject);
    if (crowded) crowd(db);
    first_ = fw_cycle(db);
    fw_handle cause = insert(db, keeper, "keeper/cause", -1, FW_PERSISTENT, 32);
    fw_handle effect = insert(db, keeper, "keeper/effect", -1, FW_PERSISTENT, 32);
    fw_handle shared = insert(db, keeper, "keeper/public", -1, FW_PERSISTENT | FW_PUBLIC_WRITE, 32);
    fw_handle old = insert(db, subject, "subject/old", -1, 0, 1000);
    fw_handle family = insert(db, subject, "subject/family", -1, 0, 32);
    fw_handle child = insert(db, subject, "subject/family/child", family, 0, 32);
    must("guest", insert(db, keeper, "keeper/guest", child, FW_PERSISTENT, 32));
    must("leaf", insert(db, subject, "subject/family/leaf", child, 0, 32));
    must("ghost", insert(db, ghost, "ghost/large", -1, 0, 2600));
    fw_handle spent[2] = {insert(db, subject, "subject/spent1", -1, FW_IMMEDIATE_DELETE, 32),
                          insert(db, subject, "subject/spent2", -1, FW_IMMEDIATE_DELETE, 300)};
    must("public", write_next(db, shared, NULL));
    must("old", write_next(db, old, NULL));
    for (int i = 0; i < 2; i++) {
        must("spent", write_next(db, spent[i], NULL));
        must("delete", fw_delete(db, spent[i]));
    }
    for (unsigned c = 1; c <= CYCLES; c++) {
        write_pair(db, cause, effect);
        must("tick", fw_tick(db));
    }
    write_pair(db, cause, effect); /* pending: what the next tick shows */
    fw_close(db);
}

/* -- the operations: `before` and `act` run in the process that dies ------------------------------------------------- */

static fw_db *mine;
static int self;
static fw_handle subject_of(const char *name) { return fw_find(mine, name); }

static void become_subject(void) { must("join", self = fw_join(mine, "subject", NULL)); }
static void take_clock(void) { must("clock", fw_clock_take(mine)); }
static void nothing_before(void) {}

static void insert_one(void) { must("insert", insert(mine, self, "subject/new", -1, 0, 200)); }
/* There is room for it only where the ghost's large object lies, behind which nobody but the spent ones lies. */
static void insert_large(void) {
    uint64_t gap = FW_LOAD(mine->dir->heap_high, relaxed) - FW_LOAD(mine->dir->heap_low, relaxed);
    must("insert", insert(mine, self, "subject/new", -1, 0, (uint32_t)(gap + 3 * FW_PAGE) / 8));
}
static void delete_one(void) { must("delete", fw_delete(mine, subject_of("subject/old"))); }
static void delete_family(void) { must("delete", fw_delete(mine, subject_of("subject/family"))); }
static void give_back(void) { if (insert(mine, self, "subject/new", -1, 0, HUGE_SIZE) != -ENOSPC) give_up("insert", 0); }
static void join_first(void) { must("join", fw_join(mine, "newcomer", &(fw_join_opts){.version = "1", .participant = 1})); }
static void leave_and_return(void) {
    must("leave", fw_leave(mine, (uint32_t)self));
    become_subject();
}
static void add_schema(void) { must("schema", fw_schema_add(mine, "{\"name\":\"New\"}", 14)); }
static void say_status(void) { must("status", fw_status(mine, (uint32_t)self, 3, "warning")); }
static void write_one(void) { must("write", write_next(mine, subject_of("subject/old"), NULL)); }
static void fill_one(void) {
    void *slot;
    fw_object o;
    must("object", fw_object_get(mine, subject_of("subject/old"), &o));
    must("begin", fw_write_begin(mine, subject_of("subject/old"), &slot));
    for (int i = 0; i < 4; i++) ((volatile uint64_t *)slot)[i] = word_of(o.head + 1);
    must("commit", fw_write_commit(mine, subject_of("subject/old"), 32, (int64_t)o.head, NULL, 0));
}
static void write_public(void) { must("write", write_next(mine, subject_of("keeper/public"), NULL)); }
static void tick_once(void) { must("tick", fw_tick(mine)); }
static void tick_twice(void) { tick_once(); tick_once(); }
static void attach(void) { must("attach", fw_attach(&mine, name_)); }
static void be_done(void) { must("done", fw_done(mine, (uint32_t)self, fw_cycle(mine) + 1)); }

static const struct {
    const char *name;
    void (*before)(void), (*act)(void); /* no `before`: it is not attached */
    const char *together[4];            /* wholly there or wholly gone */
    const char *lost;                   /* may also be gone: room was needed */
    int crowded;
} operations[] = {
    {"insert", become_subject, insert_one, {"subject/new"}, NULL, 0},
    {"insert where room is needed", become_subject, insert_large, {"subject/new"}, "ghost/", 0},
    {"free", become_subject, give_back, {NULL}, "ghost/", 0},
    {"delete", become_subject, delete_one, {"subject/old"}, NULL, 0},
    {"cascade delete", become_subject, delete_family,
     {"subject/family", "subject/family/child", "subject/family/leaf", "keeper/guest"}, NULL, 0},
    {"join", nothing_before, join_first, {"newcomer/health"}, NULL, 0},
    {"join where another was", nothing_before, join_first, {"newcomer/health"}, NULL, 1},
    {"join of a dead one's component", nothing_before, become_subject, {NULL}, NULL, 0},
    {"leave", become_subject, leave_and_return, {NULL}, NULL, 0},
    {"schema_add", nothing_before, add_schema, {NULL}, NULL, 0},
    {"status", become_subject, say_status, {NULL}, NULL, 0},
    {"write", become_subject, write_one, {NULL}, NULL, 0},
    {"begin and commit", become_subject, fill_one, {NULL}, NULL, 0},
    {"public write", become_subject, write_public, {NULL}, NULL, 0},
    {"taking the clock", nothing_before, take_clock, {NULL}, NULL, 0},
    {"tick", take_clock, tick_once, {NULL}, NULL, 0},
    {"two ticks", take_clock, tick_twice, {NULL}, NULL, 0},
    {"attach, marking the dead", NULL, attach, {NULL}, NULL, 0},
    {"done", become_subject, be_done, {NULL}, NULL, 0},
};
#define N_OPERATIONS (sizeof operations / sizeof operations[0])

/* -- what must hold afterwards --------------------------------------------------------------------------------------- */

static const char *const all[] = {"keeper/health", "keeper/cause", "keeper/effect", "keeper/public", "keeper/guest",
                                  "subject/health", "subject/old", "subject/family", "subject/family/child",
                                  "subject/family/leaf", "ghost/health", "ghost/large"};

/* The value of a write that must be readable: its words agree with each other and with its number. */
static void check_value(fw_db *db, const char *name, fw_handle h, int64_t w) {
    uint64_t words[4];
    fw_info info;
    if (w <= 0) return;
    int r = fw_read(db, h, (uint64_t)w, words, sizeof words, &info);
    if (r < 0) broken("a value is gone", name, (long)w, r);
    for (int i = 0; r == 0 && i < 4; i++)
        if (info.size != sizeof words || words[i] != word_of((uint64_t)w)) { broken("a torn value", name, (long)w, i); break; }
}

static void check_cuts(fw_db *db) {
    fw_handle cause = fw_find(db, "keeper/cause"), effect = fw_find(db, "keeper/effect");
    uint64_t now = fw_cycle(db) - first_;
    for (uint64_t c = 1; c <= now; c++) {
        int64_t a = fw_visible(db, cause, first_ + c), b = fw_visible(db, effect, first_ + c);
        if (b > a) broken("an effect without its cause", "cycle", (long)c, (long)b);
        if (c <= CYCLES && (a != (int64_t)c || b != (int64_t)c)) broken("a cut has changed", "cycle", (long)c, (long)a);
        if (c > CYCLES && a < (int64_t)CYCLES) broken("a cut has lost its value", "cycle", (long)c, (long)a);
        check_value(db, "keeper/cause", cause, a);
        check_value(db, "keeper/effect", effect, b);
    }
}

static int is_one_of(const char *name, const char *const *list, size_t n) {
    for (size_t i = 0; i < n && list[i]; i++)
        if (strcmp(name, list[i]) == 0) return 1;
    return 0;
}

static void check_presence(fw_db *db, size_t op) {
    int there = 0, n = 0;
    for (; n < 4 && operations[op].together[n]; n++) there += fw_find(db, operations[op].together[n]) >= 0;
    if (there != 0 && there != n) broken("half of what belongs together is there", operations[op].together[0], there, n);
    for (size_t i = 0; i < sizeof all / sizeof all[0]; i++) {
        if (is_one_of(all[i], operations[op].together, 4)) continue;
        if (operations[op].lost && strncmp(all[i], operations[op].lost, strlen(operations[op].lost)) == 0) continue;
        fw_handle h = fw_find(db, all[i]);
        if (h < 0) broken("an object is lost", all[i], (long)h, 0);
        else if (!strstr(all[i], "health")) check_value(db, all[i], h, fw_newest(db, h));
    }
}

static void check_directory(fw_db *db) {
    char text[256];
    int r = fw_directory_open(db);
    if (r < 0) { broken("the directory cannot be opened", "", r, 0); return; }
    const char *not = inconsistent(db, text, sizeof text);
    fw_directory_close(db);
    if (not) broken(not, "", 0, 0);
}

/* Writes every object of a component twice: whoever takes it over can. */
static void check_writing(fw_db *db, const char *of) {
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        fw_handle h = fw_entry(db, i);
        fw_object o;
        if (h < 0 || fw_object_get(db, h, &o) < 0 || o.t_delete_ns != INT64_MAX || strstr(o.spec.name, "health") ||
            strncmp(o.spec.name, of, strlen(of)) != 0) continue;
        for (uint64_t k = 1; k <= 2; k++) {
            int64_t w = write_next(db, h, NULL);
            if (w != (int64_t)(o.head + k)) broken("who took over cannot write", o.spec.name, (long)w, (long)o.head);
            check_value(db, o.spec.name, h, w);
        }
    }
}

/* Deletes everything: then all memory is there again. */
static void check_memory(fw_db *db) {
    uint64_t size, unused;
    for (uint32_t i = 0; i < fw_n_entries(db); i++) {
        fw_handle h = fw_entry(db, i);
        fw_object o;
        if (h < 0 || fw_object_get(db, h, &o) < 0 || o.t_delete_ns != INT64_MAX) continue;
        int r = fw_delete(db, h);
        if (r < 0) broken("an object cannot be deleted", o.spec.name, r, 0);
    }
    for (int i = 0; i < 3; i++) fw_tick(db);
    fw_spec spec = {.name = "verifier/huge", .size = HUGE_SIZE, .n_slots = 4, .every = 1,
                    .component = (uint32_t)fw_join(db, "collector", NULL)};
    fw_handle health = fw_find(db, "collector/health");
    if (health < 0 || fw_delete(db, health) < 0) broken("a component cannot join any more", "collector", (long)health, 0);
    for (int i = 0; i < 20; i++) fw_tick(db);
    if (fw_insert(db, &spec) != -ENOSPC) broken("there is room for what is larger than the store", "", 0, 0);
    fw_memory(db, &size, &unused);
    if (unused != size) broken("memory is lost", "bytes of", (long)(size - unused), (long)size);
}

/* Other processes go on with the store of that name after the operation was killed. */
static void verify(const char *store, size_t op) {
    fw_db *db;
    int r = fw_attach(&db, store);
    if (r < 0) { broken("nobody can attach", store, r, 0); return; }
    check_cuts(db); /* readers need nobody to tidy up first */
    r = fw_join(db, "verifier", NULL);
    if (r < 0) broken("another cannot join", "verifier", r, 0);
    fw_handle probe = insert(db, r < 0 ? 0 : r, "verifier/probe", -1, 0, 32);
    if (probe < 0) broken("another cannot insert", "verifier/probe", (long)probe, 0);
    check_directory(db);
    check_presence(db, op);
    static const char *const joined[] = {"subject", "keeper", "newcomer"};
    for (int i = 0; i < 3; i++) {
        r = fw_join(db, joined[i], NULL);
        if (r < 0) broken("a component cannot be taken over", joined[i], r, 0);
    }
    check_writing(db, "subject/");
    check_writing(db, "keeper/g");
    check_writing(db, "keeper/p");
    check_writing(db, "verifier/");
    r = fw_clock_take(db);
    if (r < 0) broken("the clock cannot be taken over", "", r, 0);
    for (int i = 0; i < 2; i++) {
        uint64_t c = fw_cycle(db);
        int64_t t = fw_tick(db);
        if (t <= (int64_t)c) broken("the clock does not go on", "cycle", (long)c, (long)t);
        check_cuts(db);
    }
    check_directory(db);
    check_presence(db, op);
    check_memory(db);
    check_directory(db);
    fw_close(db);
}

/* -- killing --------------------------------------------------------------------------------------------------------- */

/* The process that dies. */
static void act(size_t op, long at, int traced) {
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    fw_forget(maker);
    maker = NULL;
    if (operations[op].before) {
        attach();
        operations[op].before();
    }
    countdown = at;
    if (traced) {
        if (ptrace(PTRACE_TRACEME, 0, NULL, NULL) < 0) _exit(3);
        kill(getpid(), SIGSTOP);
    }
    *phase = 1;
    armed = !traced;
    operations[op].act();
    armed = 0;
    *phase = 2;
    _exit(0);
}

static pid_t start(size_t op, long at, int traced) {
    *phase = 0;
    fflush(stdout);
    pid_t child = fork();
    if (child < 0) give_up("fork", errno);
    if (child == 0) act(op, at, traced);
    return child;
}

static long kill_at_steps(size_t op) {
    for (long at = 1; at < KILLS_MAX; at++) {
        int status;
        snprintf(where, sizeof where, "%s, killed at step %ld", operations[op].name, at);
        prepare_store(operations[op].crowded);
        waitpid(start(op, at, 0), &status, 0);
        int killed = WIFSIGNALED(status) && WTERMSIG(status) == SIGKILL;
        if (!killed && !(WIFEXITED(status) && WEXITSTATUS(status) == 0)) broken("it died by itself", "status", status, 0);
        verify(name_, op);
        fw_close(maker);
        maker = NULL;
        if (!killed || failures > MANY) return at - 1;
    }
    return KILLS_MAX;
}

/* A file with these bytes, which looks as if somebody lived in it. */
static void copy_segment(const uint8_t *bytes, size_t n) {
    char path[160];
    if (copy_fd < 0) {
        snprintf(path, sizeof path, "/dev/shm/fairway-%u-%s", (unsigned)getuid(), copy_);
        copy_fd = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
        struct flock lock = {.l_type = F_RDLCK, .l_whence = SEEK_SET, .l_start = FW_LOCK_ALIVE, .l_len = 1};
        if (copy_fd < 0 || fcntl(copy_fd, F_OFD_SETLK, &lock) < 0) give_up("copy", errno);
    }
    if (pwrite(copy_fd, bytes, n, 0) != (ssize_t)n) give_up("copy", errno);
}

static void remove_copy(void) {
    char path[160];
    snprintf(path, sizeof path, "/dev/shm/fairway-%u-%s", (unsigned)getuid(), copy_);
    if (copy_fd >= 0) { close(copy_fd); unlink(path); }
}

/* Only the bit map of the heap differs: that happens bit by bit. */
static int is_a_mark(const uint8_t *before, const uint8_t *now, size_t n) {
    size_t used = (size_t)maker->map.directory + offsetof(fw_directory, used), life = (size_t)maker->map.life;
    return memcmp(before, now, used) == 0 && memcmp(before + life, now + life, n - life) == 0;
}

static long kill_at_stores(size_t op) {
    long kills = 0, marks = 0;
    int status;
    snprintf(where, sizeof where, "%s", operations[op].name);
    prepare_store(operations[op].crowded);
    size_t n = maker->map.size;
    uint8_t *before = malloc(n);
    if (!before) give_up("malloc", (long)n);
    pid_t child = start(op, 0, 1);
    waitpid(child, &status, 0);
    if (WIFEXITED(status) && WEXITSTATUS(status) == 3) { fw_close(maker); exit(3); }
    if (!WIFSTOPPED(status) || ptrace(PTRACE_SETOPTIONS, child, NULL, PTRACE_O_EXITKILL) < 0) give_up("trace", status);
    memcpy(before, maker->base, n);
    for (long step = 0; step < STEPS_MAX && *phase < 2 && failures <= MANY; step++) {
        if (ptrace(PTRACE_SINGLESTEP, child, NULL, NULL) < 0 || waitpid(child, &status, 0) != child) give_up("step", errno);
        if (!WIFSTOPPED(status) || WSTOPSIG(status) != SIGTRAP) { broken("it died by itself", "status", status, 0); break; }
        if (memcmp(before, maker->base, n) == 0) continue;
        int is_looked_at = !is_a_mark(before, maker->base, n) || marks++ % 16 == 0;
        memcpy(before, maker->base, n);
        if (!is_looked_at) continue;
        copy_segment(before, n);
        snprintf(where, sizeof where, "%s, killed behind store %ld", operations[op].name, ++kills);
        verify(copy_, op);
    }
    if (*phase < 2 && failures == 0) broken("it did not end", "kills", kills, 0);
    kill(child, SIGKILL);
    waitpid(child, &status, 0);
    free(before);
    fw_close(maker);
    maker = NULL;
    return kills;
}

int main(int argc, char **argv) {
    if (argc != 3 || (strcmp(argv[1], "steps") != 0 && strcmp(argv[1], "stores") != 0)) {
        fprintf(stderr, "usage: kill_steps steps|stores NAME\n");
        return 2;
    }
    int steps = strcmp(argv[1], "steps") == 0, broken_in_all = 0;
    if (!steps && !getenv("GLIBC_TUNABLES")) { /* string instructions, of which each byte would be a step, are not for us */
        setenv("GLIBC_TUNABLES", "glibc.cpu.x86_rep_stosb_threshold=10000000:glibc.cpu.x86_rep_movsb_threshold=10000000", 1);
        execv("/proc/self/exe", argv);
    }
    name_ = argv[2];
    snprintf(copy_, sizeof copy_, "%.40s-copy", name_);
    phase = mmap(NULL, FW_PAGE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (phase == MAP_FAILED) give_up("mmap", errno);
    alarm(300); /* whoever hangs dies, and so fails */
    for (size_t op = 0; op < N_OPERATIONS; op++) {
        failures = 0;
        long kills = steps ? kill_at_steps(op) : kill_at_stores(op);
        printf("%s: %ld kills, %d failures\n", operations[op].name, kills, failures);
        broken_in_all += failures;
    }
    remove_copy();
    return broken_in_all != 0;
}
