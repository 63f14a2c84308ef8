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

static uint64_t pages(uint64_t n) { return (n + FW_PAGE - 1) / FW_PAGE * FW_PAGE; }

/* Where everything stands, from the header's sizes alone. */
static int map_of(const fw_header *h, fw_map *m) {
    if (!h->max_objects || h->max_objects > 1u << 20 || !h->max_components || h->max_components > 1u << 16 ||
        h->schema_bytes > 1u << 28 || h->size > 1ull << 40) return -EPROTO;
    m->directory = pages(sizeof(fw_header));
    m->components = m->directory + 128;
    m->objects = m->components + sizeof(fw_centry) * (uint64_t)h->max_components;
    m->schemas = m->objects + sizeof(fw_oentry) * (uint64_t)h->max_objects;
    m->wake = pages(m->schemas + h->schema_bytes);
    m->wake_done = m->wake + 64;
    m->wake_objects = m->wake_done + 8 * (uint64_t)h->max_components;
    m->clock = pages(m->wake_objects + 4 * (uint64_t)h->max_objects);
    m->heap = m->clock + FW_PAGE;
    m->size = h->size;
    return m->heap + FW_PAGE <= h->size && h->size % FW_PAGE == 0 ? 0 : -EPROTO;
}

static int bind(fw_db *db) {
    fw_map *m = &db->map;
    db->header = (fw_header *)db->base;
    db->dir = (fw_directory *)(db->base + m->directory);
    db->components = (fw_centry *)(db->base + m->components);
    db->objects = (fw_oentry *)(db->base + m->objects);
    db->schemas = db->base + m->schemas;
    db->wake = (fw_wake *)(db->base + m->wake);
    db->done = (fw_u64 *)(db->base + m->wake_done);
    db->object_wake = (fw_u32 *)(db->base + m->wake_objects);
    db->clock = (fw_clock *)(db->base + m->clock);
    db->cuts_mapped = m->size;
    db->refs = calloc(db->header->max_objects, sizeof(fw_ref));
    db->owned = calloc(db->header->max_components, 1);
    return db->refs && db->owned ? 0 : -ENOMEM;
}

int fw_writable(fw_db *db, uint64_t off, uint64_t n, int on) {
    if (db->fd < 0) return 0;
    uint64_t first = off / FW_PAGE * FW_PAGE;
    int prot = on ? PROT_READ | PROT_WRITE : PROT_READ;
    return mprotect(db->base + first, pages(off + n) - first, prot) == 0 ? 0 : -errno;
}

/* Locks of open file descriptions: the kernel gives them back when the process dies, however it dies. */
int fw_lock(fw_db *db, int64_t byte, int type) {
    if (db->fd < 0) return 0;
    struct flock lock = {.l_type = (short)type, .l_whence = SEEK_SET, .l_start = byte, .l_len = 1};
    if (fcntl(db->fd, F_OFD_SETLK, &lock) == 0) return 0;
    return errno == EACCES || errno == EAGAIN ? -EBUSY : -errno;
}

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

/* 1 = somebody lives in the store behind path, 0 = nobody (or no such file) */
static int inhabited(const char *path) {
    fw_db probe = {.fd = open(path, O_RDWR | O_CLOEXEC)};
    if (probe.fd < 0) return errno != ENOENT;
    int busy = fw_lock_held(&probe, FW_LOCK_ALIVE);
    close(probe.fd);
    return busy;
}

static int make_file(fw_db *db, const char *name, uint64_t size) {
    char temp[160];
    int r = path_of(db->path, sizeof db->path, name);
    if (r < 0) return r;
    if (inhabited(db->path)) return -EBUSY;
    snprintf(temp, sizeof temp, "%s.%d.new", db->path, (int)getpid());
    unlink(temp);
    db->fd = open(temp, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
    if (db->fd < 0) return -errno;
    r = -posix_fallocate(db->fd, 0, (off_t)size); /* memory that is missing is missed now, not as SIGBUS later */
    if (r == 0) r = fw_lock(db, FW_LOCK_ALIVE, F_RDLCK);
    if (r == 0) r = fw_lock(db, FW_LOCK_CLOCK, F_WRLCK);
    if (r == 0) {
        db->base = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, db->fd, 0);
        if (db->base == MAP_FAILED) { db->base = NULL; r = -errno; }
    }
    if (r < 0) unlink(temp);
    return r;
}

/* Gives the finished segment its name: nobody ever attaches to one that is half made. */
static int publish_file(fw_db *db) {
    char temp[160];
    snprintf(temp, sizeof temp, "%s.%d.new", db->path, (int)getpid());
    if (inhabited(db->path)) { unlink(temp); return -EBUSY; }
    int r = rename(temp, db->path) == 0 ? 0 : -errno;
    if (r < 0) unlink(temp);
    return r;
}

static void release(fw_db *db) {
    if (db->base) munmap(db->base, db->map.size);
    if (db->fd >= 0) close(db->fd);
    free(db->refs);
    free(db->owned);
    free(db);
}

int fw_create(fw_db **out, const char *name, const fw_opts *o) {
    fw_header h = {.magic = FW_MAGIC, .layout = FW_LAYOUT,
                   .max_objects = o->max_objects ? o->max_objects : 256,
                   .max_components = o->max_components ? o->max_components : 64,
                   .schema_bytes = (uint32_t)pages(o->schema_bytes ? o->schema_bytes : 256 * 1024),
                   .size = pages(o->size ? o->size : 4 * 1024 * 1024),
                   .tick_ns = o->tick_ns ? o->tick_ns : 10000000, .t0_ns = o->t0_ns};
    fw_map map;
    if (h.tick_ns < 1000 || map_of(&h, &map) < 0) return -EINVAL;
    if (getrandom(&h.store_id, sizeof h.store_id, 0) != sizeof h.store_id) return -errno;
    fw_db *db = calloc(1, sizeof *db);
    if (!db) return -ENOMEM;
    db->fd = -1;
    db->map = map;
    int r = 0;
    if (name) r = make_file(db, name, h.size);
    else {
        db->base = mmap(NULL, h.size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
        if (db->base == MAP_FAILED) { db->base = NULL; r = -errno; }
    }
    if (r == 0) { memcpy(db->base, &h, sizeof h); r = bind(db); }
    if (r < 0) { release(db); return r; }
    FW_STORE(db->dir->next_oid, 1, relaxed);
    FW_STORE(db->dir->heap_low, map.heap, relaxed);
    FW_STORE(db->dir->heap_high, h.size, relaxed);
    db->has_clock = db->creator = db->can_wake = 1;
    if (name) {
        r = publish_file(db);
        if (r == 0) r = fw_writable(db, 0, h.size, 0);
        if (r == 0) r = fw_writable(db, map.wake, map.heap - map.wake, 1); /* wake words and clock */
        if (r < 0) { release(db); return r; }
    }
    *out = db;
    return 0;
}

int fw_attach(fw_db **out, const char *name) {
    fw_db *db = calloc(1, sizeof *db);
    if (!db) return -ENOMEM;
    int r = path_of(db->path, sizeof db->path, name);
    if (r < 0) { free(db); return r; }
    db->can_wake = 1;
    db->fd = open(db->path, O_RDWR | O_CLOEXEC);
    if (db->fd < 0 && errno == EACCES) { db->can_wake = 0; db->fd = open(db->path, O_RDONLY | O_CLOEXEC); }
    if (db->fd < 0) { r = -errno; free(db); return r; }
    fw_header h;
    struct stat st;
    if (pread(db->fd, &h, sizeof h, 0) != sizeof h || h.magic != FW_MAGIC || h.layout != FW_LAYOUT ||
        map_of(&h, &db->map) < 0 || fstat(db->fd, &st) < 0 || (uint64_t)st.st_size != h.size) r = -EPROTO;
    if (r == 0 && !fw_lock_held(db, FW_LOCK_ALIVE)) r = -EOWNERDEAD; /* left behind by a crash */
    if (r == 0) r = fw_lock(db, FW_LOCK_ALIVE, F_RDLCK);
    if (r == 0) {
        db->base = mmap(NULL, h.size, PROT_READ, MAP_SHARED, db->fd, 0);
        if (db->base == MAP_FAILED) { db->base = NULL; r = -errno; }
    }
    if (r == 0) r = bind(db);
    if (r == 0 && db->can_wake && fw_writable(db, db->map.wake, db->map.clock - db->map.wake, 1) < 0) db->can_wake = 0;
    if (r < 0) { release(db); return r; }
    *out = db;
    return 0;
}

void fw_close(fw_db *db) {
    if (db->fd >= 0 && db->creator) unlink(db->path);
    release(db);
}

int64_t fw_tick_ns(const fw_db *db) { return db->header->tick_ns; }
int64_t fw_t0_ns(const fw_db *db) { return db->header->t0_ns; }
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
    const fw_directory *dir = (const fw_directory *)((const uint8_t *)image + db->map.directory);
    uint64_t low = FW_LOAD(dir->heap_low, relaxed), high = FW_LOAD(dir->heap_high, relaxed);
    if (low > high || high > db->map.size || n != low + (db->map.size - high)) return -EPROTO;
    memcpy(db->base, image, low);
    memcpy(db->base + high, (const uint8_t *)image + low, db->map.size - high);
    if (db->n_refs > FW_LOAD(db->dir->n_objects, relaxed)) db->n_refs = FW_LOAD(db->dir->n_objects, relaxed);
    for (uint32_t i = 0; i < db->n_refs; i++) db->refs[i].begun = 0;
    return 0;
}
