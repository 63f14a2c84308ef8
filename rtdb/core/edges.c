/* edges.c - cycles as a file descriptor, for programs whose one place to wait is poll(2). */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>
#include <unistd.h>

#include "fw_layout.h"

struct fw_edges {
    pthread_t thread;
    fw_db *db;
    uint64_t after;
    int fds[2]; /* of a pipe: read, written */
    int stop;
};

static int64_t ticked_or_stopped(fw_db *db, const void *what) {
    const fw_edges *edges = what;
    uint64_t c = fw_cycle(db);
    return c > edges->after ? (int64_t)c : __atomic_load_n(&edges->stop, __ATOMIC_SEQ_CST) ? -ECANCELED : 0;
}

static void *run(void *arg) {
    fw_edges *edges = arg;
    for (;;) {
        int64_t c = fw_wait_for(edges->db, &edges->db->wake->clock, ticked_or_stopped, edges, INT64_MAX);
        if (__atomic_load_n(&edges->stop, __ATOMIC_SEQ_CST)) return NULL;
        if (c < 0) continue; /* a signal */
        edges->after = (uint64_t)c;
        ssize_t n = write(edges->fds[1], "", 1); /* a full pipe is readable already */
        (void)n;
    }
}

void fw_edges_forget(fw_edges *edges) {
    for (int k = 0; k < 2; k++)
        if (edges->fds[k] >= 0) close(edges->fds[k]);
    if (edges->db) fw_close(edges->db);
    free(edges);
}

int fw_edges_start(fw_edges **out, const char *name, uint64_t after) {
    fw_edges *edges = calloc(1, sizeof *edges);
    if (!edges) return -ENOMEM;
    edges->after = after;
    edges->fds[0] = edges->fds[1] = -1;
    int r = fw_attach(&edges->db, name);
    if (r == 0 && pipe2(edges->fds, O_NONBLOCK | O_CLOEXEC) < 0) r = -errno;
    if (r == 0) {
        sigset_t all, before; /* signals are for the threads that somebody else wrote */
        sigfillset(&all);
        pthread_sigmask(SIG_SETMASK, &all, &before);
        r = -pthread_create(&edges->thread, NULL, run, edges);
        pthread_sigmask(SIG_SETMASK, &before, NULL);
    }
    if (r < 0) { fw_edges_forget(edges); return r; }
    *out = edges;
    return 0;
}

int fw_edges_fd(const fw_edges *edges) { return edges->fds[0]; }

void fw_edges_stop(fw_edges *edges) {
    __atomic_store_n(&edges->stop, 1, __ATOMIC_SEQ_CST);
    fw_tell(edges->db, &edges->db->wake->clock);
    pthread_join(edges->thread, NULL);
    fw_edges_forget(edges);
}
