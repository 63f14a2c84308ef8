/* cut_race.c - one process writes flat out, another looks for what it must never see.
 *
 *   cut_race cut  NAME TICKS   ticks flat out; the writer writes A = k, then B = k. A cut that shows B > A shows an
 *                              effect without its cause. Ends at the first one.
 *   cut_race torn NAME READS   reads the newest of 64 and of 4096 bytes from rings of 4 slots. A value whose words
 *                              differ, and which the store called whole, is torn.
 *
 * Exit status 0: nothing wrong was seen. 1: it was, and a line says what. Others: the program could not do its work.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include "fw_rtdb.h"

#define FILLERS 254u /* they stand between A and B in the directory, so that the pass takes a while from A to B */
#define SLOTS 4096u
#define SMALL 64u
#define LARGE 4096u

static pid_t child;

static int quit(int status, const char *what, long r) {
    if (what) fprintf(stderr, "%s: %ld\n", what, r);
    if (child > 0) { kill(child, SIGKILL); waitpid(child, NULL, 0); }
    return status;
}

static fw_handle insert(fw_db *db, int component, const char *name, uint32_t size, uint32_t n_slots) {
    fw_spec spec = {.size = size, .n_slots = n_slots, .every = 1, .component = (uint32_t)component};
    snprintf(spec.name, sizeof spec.name, "w/%s", name);
    return fw_insert(db, &spec);
}

/* What both writers begin with; the parent kills them. */
static fw_db *writer_attach(const char *name, int *component) {
    fw_db *db;
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (fw_attach(&db, name) < 0 || (*component = fw_join(db, "w", NULL)) < 0) _exit(10);
    return db;
}

static void write_pairs(const char *name) {
    int component;
    fw_db *db = writer_attach(name, &component);
    fw_handle a = insert(db, component, "a", 8, SLOTS);
    for (unsigned i = 0; i < FILLERS; i++) {
        char filler[16];
        snprintf(filler, sizeof filler, "f%u", i);
        if (insert(db, component, filler, 8, 4) < 0) _exit(11);
    }
    fw_handle b = insert(db, component, "b", 8, SLOTS);
    if (a < 0 || b < 0) _exit(12);
    for (uint64_t k = 1;; k++) {
        int64_t r;
        while ((r = fw_write(db, a, &k, 8, 0, NULL, 0)) == -EBUSY) ;
        if (r < 0) _exit(13);
        while ((r = fw_write(db, b, &k, 8, 0, NULL, 0)) == -EBUSY) ;
        if (r < 0) _exit(13);
    }
}

static void write_words(const char *name) {
    static uint64_t words[LARGE / 8];
    int component;
    fw_db *db = writer_attach(name, &component);
    fw_handle small = insert(db, component, "small", SMALL, 4), large = insert(db, component, "large", LARGE, 4);
    if (small < 0 || large < 0) _exit(12);
    for (uint64_t k = 1;; k++) {
        for (unsigned i = 0; i < LARGE / 8; i++) words[i] = k;
        if (fw_write(db, small, words, SMALL, 0, NULL, 0) < 0) _exit(13);
        if (fw_write(db, large, words, LARGE, 0, NULL, 0) < 0) _exit(13);
    }
}

/* 0, with the value that cut c shows of an object; also 0 when the slots wrapped since (*seen tells) */
static int value_at(fw_db *db, fw_handle object, uint64_t c, uint64_t *value, int *seen) {
    fw_info info;
    int64_t w = fw_visible(db, object, c);
    *value = *seen = 0;
    if (w == 0) { *seen = 1; return 0; }
    if (w == -ESTALE) return 0;
    if (w < 0) return (int)w;
    int r = fw_read(db, object, (uint64_t)w, value, 8, &info);
    *seen = r == 0;
    return r == -ESTALE ? 0 : r;
}

/* The object, once the writer has inserted it. */
static fw_handle await(fw_db *db, const char *name) {
    for (;;) {
        uint64_t version = fw_directory_version(db);
        fw_handle object = fw_find(db, name);
        if (object >= 0 || fw_wait_directory(db, version, 10000000000) < 0) return object;
    }
}

static int cut(fw_db *db, long ticks) {
    fw_handle b = await(db, "w/b"), a = fw_find(db, "w/a"); /* b is the last one */
    if (a < 0 || b < 0) return quit(2, "the writer did not come up", 0);
    long compared = 0, advanced = 0;
    uint64_t before = 0;
    for (long i = 0; i < ticks; i++) {
        int64_t c = fw_tick(db);
        if (c < 0) return quit(3, "tick", (long)c);
        uint64_t value_a, value_b;
        int seen_a, seen_b, r;
        if ((r = value_at(db, a, (uint64_t)c, &value_a, &seen_a)) < 0) return quit(4, "read a", r);
        if ((r = value_at(db, b, (uint64_t)c, &value_b, &seen_b)) < 0) return quit(4, "read b", r);
        if (!seen_a || !seen_b) continue;
        compared++;
        advanced += value_a != before;
        before = value_a;
        if (value_b > value_a) {
            printf("tick %ld a %lu b %lu\n", i + 1, (unsigned long)value_a, (unsigned long)value_b);
            return quit(1, NULL, 0);
        }
    }
    printf("compared %ld advanced %ld\n", compared, advanced);
    return quit(0, NULL, 0);
}

static int uniform(const volatile uint64_t *words, uint32_t n) {
    for (uint32_t i = 1; i < n / 8; i++)
        if (words[i] != words[0]) return 0;
    return 1;
}

static int torn(fw_db *db, long reads) {
    static uint64_t buffer[LARGE / 8];
    fw_handle large = await(db, "w/large"), objects[2] = {fw_find(db, "w/small"), large}; /* large is the last one */
    if (objects[0] < 0 || large < 0) return quit(2, "the writer did not come up", 0);
    while (fw_newest(db, large) <= 0)
        if (waitpid(child, NULL, WNOHANG) != 0) return quit(2, "the writer died", 0);
    long whole = 0, refused = 0, prevented = 0, tears = 0;
    for (long i = 0; i < reads || (prevented == 0 && i < 20 * reads); i++) {
        fw_handle object = objects[i & 1];
        fw_info info;
        int64_t w = fw_newest(db, object);
        int r = fw_read(db, object, (uint64_t)w, buffer, sizeof buffer, &info);
        if (r == 0) {
            whole++;
            tears += !uniform(buffer, info.size) || info.size != (i & 1 ? LARGE : SMALL) || buffer[0] != (uint64_t)w;
        } else if (r != -ESTALE) return quit(4, "read", r);
        else refused++;
        /* the same without the second check: shows that there was something to prevent */
        const void *data;
        if (fw_peek(db, object, (uint64_t)fw_newest(db, object), &data, &info) < 0) continue;
        int same = uniform(data, info.size);
        if (!same) {
            if (fw_check(db, object, info.write) == 0) tears++;
            else prevented++;
        }
    }
    printf("whole %ld refused %ld prevented %ld torn %ld\n", whole, refused, prevented, tears);
    return quit(tears ? 1 : 0, NULL, 0);
}

int main(int argc, char **argv) {
    if (argc != 4) return quit(2, "usage: cut_race cut|torn NAME COUNT", argc);
    int cuts = strcmp(argv[1], "cut") == 0;
    long count = atol(argv[3]);
    fw_db *db;
    fw_opts opts = {.size = 8u << 20, .max_objects = FILLERS + 3} /* w's health too */;
    int r = fw_create(&db, argv[2], &opts);
    if (r < 0) return quit(2, "create", r);
    child = fork();
    if (child < 0) return quit(2, "fork", errno);
    if (child == 0) { if (cuts) write_pairs(argv[2]); else write_words(argv[2]); }
    int status = cuts ? cut(db, count) : torn(db, count);
    fw_close(db);
    return status;
}
