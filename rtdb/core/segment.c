/* segment.c - making, finding and mapping stores; locks; who lives. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <unistd.h>

#include "fw_layout.h"

static uint64_t pages(uint64_t n) { return fw_round_up(n, FW_PAGE); }

/* Where everything stands, from the header's sizes alone. */
static int map_of(const fw_header *h, fw_map *m) {
    if (!h->max_objects || h->max_objects > 1u << 20 || !h->max_components || h->max_components > 1u << 16 ||
        h->schema_bytes > 1u << 28 || h->schema_bytes % 8 || h->size > 1ull << 40 || h->kind > FW_REAL ||
        h->tick_ns < 1000 || h->tick_ns > 1000000000000) return -EPROTO;
    m->directory = pages(sizeof(fw_header));
    m->life = m->directory + pages(sizeof(fw_directory));
    m->death = m->life + sizeof(fw_life) * (uint64_t)h->max_objects;
    m->hash = m->death + sizeof(fw_death) * (uint64_t)h->max_objects;
    m->components = pages(m->hash + 8 * (uint64_t)h->max_objects);
    m->objects = m->components + sizeof(fw_centry) * (uint64_t)h->max_components;
    m->schemas = pages(m->objects + sizeof(fw_oentry) * (uint64_t)h->max_objects);
    m->wake = pages(m->schemas + h->schema_bytes);
    m->done = m->wake + 64;
    m->object_wake = m->done + 8 * (uint64_t)h->max_components;
    m->clock = pages(m->object_wake + 4 * (uint64_t)h->max_objects);
    m->missed = m->clock + fw_round_up(sizeof(fw_clock), 64);
    m->lives = m->missed + fw_round_up(8 * (uint64_t)h->max_components, 64);
    m->heap = pages(m->lives + (sizeof(fw_cuts) + FW_LIVES * sizeof(fw_cut)) * (uint64_t)h->max_components);
    m->size = h->size;
    if (m->heap + FW_PAGE > h->size || h->size % FW_PAGE) return -EPROTO;
    for (m->granule = 64; m->granule * FW_GRANULES < m->size - m->heap; m->granule *= 2) ;
    m->heap = fw_round_up(m->heap, m->granule < FW_PAGE ? FW_PAGE : m->granule);
    if (m->heap + FW_PAGE > h->size) return -EPROTO;
    return 0;
}

static int bind(fw_db *db) {
    const fw_map *m = &db->map;
    db->header = (fw_header *)db->base;
    db->dir = (fw_directory *)(db->base + m->directory);
    db->life = (fw_life *)(db->base + m->life);
    db->death = (fw_death *)(db->base + m->death);
    db->hash = (fw_u64 *)(db->base + m->hash);
    db->components = (fw_centry *)(db->base + m->components);
    db->objects = (fw_oentry *)(db->base + m->objects);
    db->schemas = db->base + m->schemas;
    db->wake = (fw_wake *)(db->base + m->wake);
    db->done = (fw_u64 *)(db->base + m->done);
    db->object_wake = (fw_u32 *)(db->base + m->object_wake);
    db->clock = (fw_clock *)(db->base + m->clock);
    db->missed = (fw_u64 *)(db->base + m->missed);
    db->lives = db->base + m->lives;
    db->cuts_mapped = m->size;
    db->version = UINT64_MAX;
    if (db->fd >= 0) /* an area of its own to the kernel: opening and closing it for a change splits and joins none */
        madvise(db->base + m->directory, m->components - m->directory, MADV_DONTDUMP);
    db->refs = calloc(db->header->max_objects, sizeof(fw_ref));
    db->self = calloc(db->header->max_components, sizeof(fw_self));
    return db->refs && db->self ? 0 : -ENOMEM;
}

int fw_writable(fw_db *db, uint64_t off, uint64_t n, int on) {
    if (db->fd < 0 || n == 0) return 0;
    uint64_t first = off / FW_PAGE * FW_PAGE;
    int prot = on ? PROT_READ | PROT_WRITE : PROT_READ;
    return mprotect(db->base + first, pages(off + n) - first, prot) == 0 ? 0 : -errno;
}

int fw_put(fw_db *db, uint64_t off, const void *data, uint64_t n) {
    if (db->fd < 0) { memcpy(db->base + off, data, n); return 0; }
    ssize_t done = pwrite(db->fd, data, n, (off_t)off);
    return done < 0 ? -errno : (uint64_t)done == n ? 0 : -EIO;
}

/* Locks of open file descriptions: the kernel gives them back when the process dies, however it dies. */
static int lock_file(int fd, int64_t byte, int type) {
    struct flock lock = {.l_type = (short)type, .l_whence = SEEK_SET, .l_start = byte, .l_len = 1};
    if (fcntl(fd, F_OFD_SETLK, &lock) == 0) return 0;
    return errno == EACCES || errno == EAGAIN ? -EBUSY : -errno;
}

int fw_lock(fw_db *db, int64_t byte, int type) { return db->fd < 0 ? 0 : lock_file(db->fd, byte, type); }

int fw_lock_held(const fw_db *db, int64_t byte) {
    if (db->fd < 0) return 1;
    struct flock lock = {.l_type = F_WRLCK, .l_whence = SEEK_SET, .l_start = byte, .l_len = 1};
    return fcntl(db->fd, F_OFD_GETLK, &lock) == 0 && lock.l_type != F_UNLCK;
}

static int path_of(char *path, size_t n, const char *name) {
    if (!name[0] || strlen(name) > 48 || strspn(name, "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._-")
        != strlen(name) || name[0] == '.') return -EINVAL;
    snprintf(path, n, "/dev/shm/fairway-%u-%s", (unsigned)getuid(), name);
    return 0;
}

/* The largest object id that an abandoned store may have given out. */
static uint64_t last_oid(int fd) {
    fw_header h;
    fw_map map;
    uint64_t next = 0;
    if (pread(fd, &h, sizeof h, 0) == sizeof h && h.magic == FW_MAGIC && h.layout == FW_LAYOUT && map_of(&h, &map) == 0 &&
        pread(fd, &next, 8, (off_t)(map.directory + offsetof(fw_directory, next_oid))) != 8) next = 0;
    return next;
}

static int make_file(fw_db *db, uint64_t size) {
    char temp[160];
    snprintf(temp, sizeof temp, "%s.%d.new", db->path, (int)getpid());
    unlink(temp);
    db->fd = open(temp, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (db->fd < 0) return -errno;
    int r = -posix_fallocate(db->fd, 0, (off_t)size); /* memory that is missing is missed now, not as SIGBUS later */
    if (r == 0) r = fw_lock(db, FW_LOCK_ALIVE, F_RDLCK);
    if (r == 0) {
        db->base = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, db->fd, 0);
        if (db->base == MAP_FAILED) { db->base = NULL; r = -errno; }
    }
    if (r < 0) unlink(temp);
    return r;
}

/* Gives the finished segment its name: nobody ever attaches to one that is half made. What a crash left behind is
 * replaced under its own lock, which only one can get, and only while nobody lives in it. */
static int publish_file(fw_db *db) {
    char temp[160];
    snprintf(temp, sizeof temp, "%s.%d.new", db->path, (int)getpid());
    int r = link(temp, db->path) == 0 ? 0 : -errno;
    if (r == -EEXIST) {
        int old = open(db->path, O_RDWR | O_CLOEXEC);
        r = old < 0 ? -EBUSY : lock_file(old, FW_LOCK_ALIVE, F_WRLCK);
        struct stat mine, there;
        if (r == 0 && (fstat(old, &mine) < 0 || stat(db->path, &there) < 0 || mine.st_ino != there.st_ino)) r = -EBUSY;
        if (r == 0) {
            uint64_t next = last_oid(old);
            if (next > FW_LOAD(db->dir->next_oid, relaxed)) FW_STORE(db->dir->next_oid, next, relaxed);
            r = rename(temp, db->path) == 0 ? 0 : -errno;
        }
        if (old >= 0) close(old);
    }
    unlink(temp);
    return r;
}

static void release(fw_db *db) {
    if (db->base) munmap(db->base, db->map.size);
    if (db->fd >= 0) close(db->fd);
    free(db->refs);
    free(db->self);
    free(db);
}

int fw_create(fw_db **out, const char *name, const fw_opts *o) {
    fw_header h = {.magic = FW_MAGIC, .layout = FW_LAYOUT, .kind = o->clock, .deterministic = o->deterministic != 0,
                   .max_objects = o->max_objects ? o->max_objects : 256,
                   .max_components = o->max_components ? o->max_components : 64,
                   .schema_bytes = (uint32_t)pages(o->schema_bytes ? o->schema_bytes : 256 * 1024),
                   .size = pages(o->size ? o->size : 4 * 1024 * 1024),
                   .tick_ns = o->tick_ns ? o->tick_ns : 10000000, .t0_ns = o->t0_ns,
                   .offset_ns = fw_platform_unix_ns() - fw_platform_monotonic_ns()};
    fw_map map;
    if (map_of(&h, &map) < 0 || (!name && h.kind != FW_STEPPED)) return -EINVAL;
    if (getrandom(&h.store_id, sizeof h.store_id, 0) != sizeof h.store_id) return -errno;
    fw_db *db = calloc(1, sizeof *db);
    if (!db) return -ENOMEM;
    db->fd = -1;
    db->map = map;
    int r = name ? path_of(db->path, sizeof db->path, name) : 0;
    if (r == 0 && name) r = make_file(db, h.size);
    else if (r == 0) {
        db->base = mmap(NULL, h.size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (db->base == MAP_FAILED) { db->base = NULL; r = -errno; }
    }
    if (r == 0) { memcpy(db->base, &h, sizeof h); r = bind(db); }
    if (r < 0) { release(db); return r; }
    /* ids of a shared store begin with its birth in ns, so that no later store of that name gives them again */
    FW_STORE(db->dir->next_oid, name ? (uint64_t)fw_platform_unix_ns() : 1, relaxed);
    FW_STORE(db->dir->next_life, 1, relaxed);
    FW_STORE(db->dir->heap_low, map.heap, relaxed);
    FW_STORE(db->dir->heap_high, h.size, relaxed);
    FW_STORE(db->clock->t0_ns, (uint64_t)(h.kind == FW_REAL ? h.offset_ns + fw_platform_monotonic_ns() : h.t0_ns), relaxed);
    FW_STORE(db->clock->pid, (uint64_t)getpid(), relaxed);
    db->creator = db->can_wake = 1;
    db->has_clock = h.kind == FW_STEPPED;
    if (name) {
        if (db->has_clock) r = fw_lock(db, FW_LOCK_CLOCK, F_WRLCK);
        if (r == 0) r = publish_file(db);
        if (r < 0) { db->creator = 0; release(db); return r; }
        r = fw_writable(db, 0, h.size, 0);
        if (r == 0) r = fw_writable(db, map.wake, (db->has_clock ? map.heap : map.clock) - map.wake, 1);
        if (r < 0) { fw_close(db); return r; }
    }
    *out = db;
    return 0;
}

/* Opens the file, checks it and says "I live here", on the file that bears the name and no other. */
static int enter(fw_db *db) {
    for (int i = 0; i < 10; i++) {
        struct stat mine;
        fw_header h;
        db->can_wake = 1;
        db->fd = open(db->path, O_RDWR | O_CLOEXEC);
        if (db->fd < 0 && errno == EACCES) { db->can_wake = 0; db->fd = open(db->path, O_RDONLY | O_CLOEXEC); }
        if (db->fd < 0) return -errno;
        if (pread(db->fd, &h, sizeof h, 0) != sizeof h || h.magic != FW_MAGIC || h.layout != FW_LAYOUT ||
            map_of(&h, &db->map) < 0 || fstat(db->fd, &mine) < 0 || (uint64_t)mine.st_size != h.size) return -EPROTO;
        if (!fw_lock_held(db, FW_LOCK_ALIVE)) return -EOWNERDEAD; /* left behind by a crash */
        if (fw_lock(db, FW_LOCK_ALIVE, F_RDLCK) == 0 && fw_bears_name(db)) return 0;
        close(db->fd); /* it was replaced meanwhile */
        db->fd = -1;
    }
    return -EBUSY;
}

int fw_attach(fw_db **out, const char *name) {
    fw_db *db = calloc(1, sizeof *db);
    if (!db) return -ENOMEM;
    db->fd = -1;
    int r = path_of(db->path, sizeof db->path, name);
    if (r == 0) r = enter(db);
    if (r == 0) {
        db->base = mmap(NULL, db->map.size, PROT_READ, MAP_SHARED, db->fd, 0);
        if (db->base == MAP_FAILED) { db->base = NULL; r = -errno; }
    }
    if (r == 0) r = bind(db);
    if (r == 0 && db->can_wake && fw_writable(db, db->map.wake, db->map.clock - db->map.wake, 1) < 0) db->can_wake = 0;
    if (r < 0) { release(db); return r; }
    fw_mark_dead(db);
    *out = db;
    return 0;
}

int fw_bears_name(const fw_db *db) {
    struct stat mine, there;
    return db->fd >= 0 && fstat(db->fd, &mine) == 0 && stat(db->path, &there) == 0 && mine.st_ino == there.st_ino;
}

void fw_close(fw_db *db) {
    if (db->fd >= 0 && db->creator) unlink(db->path);
    release(db);
}

void fw_forget(fw_db *db) {
    release(db); /* closing a copy of the descriptor: the locks belong to its open description and stay with the parent */
}

int64_t fw_tick_ns(const fw_db *db) { return db->header->tick_ns; }
int64_t fw_t0_ns(const fw_db *db) { return (int64_t)FW_LOAD(db->clock->t0_ns, acquire); }
uint64_t fw_store_id(const fw_db *db) { return db->header->store_id; }

/* An image is the two used ends of the memory: [0, heap_low) and [heap_high, size). */
size_t fw_image_size(const fw_db *db) {
    if (db->fd >= 0) return 0;
    return FW_LOAD(db->dir->heap_low, relaxed) + (db->map.size - FW_LOAD(db->dir->heap_high, relaxed));
}

int fw_save(const fw_db *db, void *image, size_t n) {
    if (db->fd >= 0) return -EPERM;
    if (n != fw_image_size(db)) return -EMSGSIZE;
    uint64_t low = FW_LOAD(db->dir->heap_low, relaxed), high = FW_LOAD(db->dir->heap_high, relaxed);
    memcpy(image, db->base, low);
    memcpy((uint8_t *)image + low, db->base + high, db->map.size - high);
    return 0;
}

int fw_restore(fw_db *db, const void *image, size_t n) {
    const fw_header *h = image;
    if (db->fd >= 0) return -EPERM;
    if (n < db->map.heap || memcmp(h, db->header, sizeof *h) != 0) return -EPROTO; /* an image of another store */
    fw_directory *dir = (fw_directory *)((uintptr_t)image + db->map.directory);
    uint64_t low = FW_LOAD(dir->heap_low, relaxed), high = FW_LOAD(dir->heap_high, relaxed);
    if (low > high || high > db->map.size || n != low + (db->map.size - high)) return -EPROTO;
    uint64_t next_life = FW_LOAD(db->dir->next_life, relaxed), version = FW_LOAD(db->dir->version, relaxed);
    uint32_t n_components = FW_LOAD(dir->n_components, relaxed);
    for (uint32_t i = n_components; i < fw_n_components(db); i++) /* who joined since then has not joined */
        if (db->self[i].owned) { db->self[i].owned = 0; db->n_owned--; }
    memset(db->refs, 0, sizeof *db->refs * FW_LOAD(db->dir->n_entries, relaxed));
    memcpy(db->base, image, low);
    memcpy(db->base + high, (const uint8_t *)image + low, db->map.size - high);
    FW_STORE(db->dir->next_life, next_life, relaxed); /* handles made since then never come to mean another object */
    FW_STORE(db->dir->version, version + 1, relaxed);
    db->version = UINT64_MAX;
    return 0;
}
