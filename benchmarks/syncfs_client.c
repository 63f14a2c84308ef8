/* syncfs_client.c - one component as a client of the file server, which costs next to nothing itself. Compiled and run
 * by syncfs.py, whose function `component` is the same in Python.
 *
 *   syncfs_client SOCKET NAME SECONDS FIFO OTHER1 OTHER2 OTHER3 OTHER4
 *
 * NAME is the component and its token; FIFO 1 asks for SCHED_FIFO. It says "ready", waits for a line, and does at each
 * edge what a component does: reads what four others say, and says something itself. Then one line of JSON:
 *
 *   {"edges": n, "missed": n, "fifo": whether it had SCHED_FIFO, "late_ns": [woken - edge, sorted and evenly thinned]}
 *
 * Woken is CLOCK_MONOTONIC and the edge is store time: the caller adds the distance of the two clocks.
 * Messages are those of rtdb/syncfs/codec.py: size[4] type[1] tag[2] body, little-endian; one is under way at a time.
 */
#define _POSIX_C_SOURCE 200809L
#include <errno.h>
#include <fcntl.h>
#include <inttypes.h>
#include <sched.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

enum { RLERROR = 7, TLOPEN = 12, TGETATTR = 24, TFSYNC = 50, TVERSION = 100, TATTACH = 104, TWALK = 110, TREAD = 116,
       TWRITE = 118 };
enum { ROOT, CLOCK, STATUS, FIRST_OTHER, N_OTHERS = 4 }; /* fids */
enum { HEADER = 7, QID = 13, MSIZE = 131072, READ_BYTES = 8192, MOST_VALUES = 20000, PRIORITY = 40 };
#define NONE 0xffffffffu /* no fid, no user */

struct connection {
    const char *name; /* of the component */
    int sock;
    size_t n_out;
    uint8_t out[1024], in[2 * READ_BYTES];
};

static _Noreturn void die(const struct connection *c, const char *what, const char *why) {
    fprintf(stderr, "syncfs_client %s: %s: %s\n", c->name, what, why);
    exit(1);
}

static int64_t now_ns(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

/* -- messages -- */

static void put(struct connection *c, uint64_t value, size_t n_bytes) {
    if (c->n_out + n_bytes > sizeof c->out) die(c, "request", "it is too long");
    for (size_t k = 0; k < n_bytes; k++) c->out[c->n_out++] = (uint8_t)(value >> 8 * k);
}

static uint64_t get(const uint8_t *from, size_t n_bytes) {
    uint64_t value = 0;
    while (n_bytes--) value = value << 8 | from[n_bytes];
    return value;
}

static void receive(struct connection *c, const char *what) {
    for (size_t got = 0, whole = HEADER; got < whole;) {
        ssize_t n = recv(c->sock, c->in + got, sizeof c->in - got, 0);
        if (n <= 0) die(c, what, n < 0 ? strerror(errno) : "the server has closed the connection");
        got += (size_t)n;
        if (got >= HEADER) whole = get(c->in, 4);
        if (whole < HEADER || whole > sizeof c->in || got > whole) die(c, what, "the answer's size is wrong");
    }
}

/* Asks, and returns the body of the answer, which stays good until the next call. size: of that body, 0 where it
 * varies. layout, as in codec.py: 2, 4: unsigned; 8: uint64_t; s, d: text behind its length of 2, 4 bytes. */
static const uint8_t *call(struct connection *c, const char *what, uint8_t type, size_t size, const char *layout, ...) {
    va_list values;
    va_start(values, layout);
    c->n_out = 0;
    put(c, 0, 4); /* its size, once that is known */
    put(c, type, 1);
    put(c, type == TVERSION ? 0xffff : 1, 2); /* the tag */
    for (; *layout; layout++) {
        if (*layout == 's' || *layout == 'd') {
            const char *text = va_arg(values, const char *);
            put(c, strlen(text), *layout == 's' ? 2 : 4);
            while (*text) put(c, (uint8_t)*text++, 1);
        } else {
            put(c, *layout == '8' ? va_arg(values, uint64_t) : va_arg(values, unsigned), (size_t)(*layout - '0'));
        }
    }
    va_end(values);
    for (size_t k = 0; k < 4; k++) c->out[k] = (uint8_t)(c->n_out >> 8 * k);
    if (send(c->sock, c->out, c->n_out, MSG_NOSIGNAL) != (ssize_t)c->n_out) die(c, what, strerror(errno));
    receive(c, what);
    size_t got = get(c->in, 4) - HEADER;
    if (c->in[4] == RLERROR && got == 4) die(c, what, strerror((int)get(c->in + HEADER, 4)));
    if (c->in[4] != type + 1) die(c, what, "the answer is of another type");
    if (memcmp(c->in + 5, c->out + 5, 2)) die(c, what, "the answer has another tag");
    if (size && got != size) die(c, what, "the answer has not the size of its type");
    return c->in + HEADER;
}

static void attach(struct connection *c, const char *path) {
    struct sockaddr_un where = {.sun_family = AF_UNIX};
    if (strlen(path) >= sizeof where.sun_path) die(c, path, "the path is too long");
    strcpy(where.sun_path, path);
    c->sock = socket(AF_UNIX, SOCK_STREAM, 0);
    if (c->sock < 0 || connect(c->sock, (struct sockaddr *)&where, sizeof where)) die(c, path, strerror(errno));
    const uint8_t *agreed = call(c, "Tversion", TVERSION, 0, "4s", MSIZE, "9P2000.L");
    if (get(c->in, 4) != HEADER + 14 || memcmp(agreed + 6, "9P2000.L", 8)) die(c, "Tversion", "9P2000.L is not spoken");
    call(c, "Tattach", TATTACH, QID, "44ss4", ROOT, NONE, "", c->name, NONE);
}

static void walk(struct connection *c, unsigned fid, const char *component, const char *file) {
    const uint8_t *walked = call(c, component, TWALK, 0, "442ss", ROOT, fid, 2, component, file);
    if (get(walked, 2) != 2) die(c, component, "the file is not there");
}

static void open_status(struct connection *c, unsigned fid, const char *component, unsigned flags) {
    walk(c, fid, component, "status");
    call(c, "Tlopen", TLOPEN, QID + 4, "44", fid, flags);
}

static uint64_t wait_edge(struct connection *c, int64_t *late_ns) { /* returns how many edges there were */
    const uint8_t *attr = call(c, "Tgetattr", TGETATTR, 153, "48", CLOCK, (uint64_t)0x3fff);
    int64_t woken_ns = now_ns();
    *late_ns = woken_ns - (int64_t)(get(attr + 89, 8) * 1000000000 + get(attr + 97, 8)); /* mtime */
    return get(attr + 145, 8);                                                           /* data_version */
}

static void read_status(struct connection *c, unsigned fid) {
    const uint8_t *data = call(c, "Tread", TREAD, 0, "484", fid, (uint64_t)0, READ_BYTES);
    if (get(c->in, 4) < HEADER + 4 || get(data, 4) != get(c->in, 4) - HEADER - 4) die(c, "Tread", "its sizes differ");
}

static void write_status(struct connection *c, uint64_t n) {
    char text[40];
    snprintf(text, sizeof text, "{\"n\": %" PRIu64 "}\n", n);
    uint64_t taken = get(call(c, "Twrite", TWRITE, 4, "48d", STATUS, (uint64_t)0, text), 4);
    if (taken != strlen(text)) die(c, "Twrite", "a part was taken");
}

/* -- what is measured -- */

static int order(const void *a, const void *b) {
    int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv) {
    static struct connection c = {.name = ""};
    if (argc != 5 + N_OTHERS) die(&c, "usage", "SOCKET NAME SECONDS FIFO(0|1) OTHER1 OTHER2 OTHER3 OTHER4");
    c.name = argv[2];
    if (!strcmp(argv[4], "1")) sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){.sched_priority = PRIORITY});
    attach(&c, argv[1]);
    walk(&c, CLOCK, c.name, "clock");
    open_status(&c, STATUS, c.name, O_WRONLY);
    write_status(&c, 0);
    call(&c, "Tfsync", TFSYNC, 0, "44", STATUS, 0);
    puts("\"ready\"");
    fflush(stdout);
    for (int byte; (byte = getchar()) != '\n';)
        if (byte == EOF) die(&c, "stdin", "it ended before the line that begins");
    for (unsigned k = 0; k < N_OTHERS; k++) /* only now have all attached, which makes their files */
        open_status(&c, FIRST_OTHER + k, argv[5 + k], O_RDONLY);

    size_t edges = 0, room = 0;
    uint64_t missed = 0, last = 0;
    int64_t *late_ns = NULL, end_ns = now_ns() + (int64_t)(1e9 * atof(argv[3]));
    while (now_ns() < end_ns) {
        if (edges == room) late_ns = realloc(late_ns, (room = room ? 2 * room : 1 << 16) * sizeof *late_ns);
        if (!late_ns) die(&c, "memory", "there is none");
        uint64_t n = wait_edge(&c, &late_ns[edges]);
        if (edges++ && n > last + 1) missed += n - last - 1;
        last = n;
        for (unsigned k = 0; k < N_OTHERS; k++) read_status(&c, FIRST_OTHER + k);
        write_status(&c, n);
    }
    close(c.sock); /* before it may wait for a reader of its line: a barrier waits for us until then */

    if (edges) qsort(late_ns, edges, sizeof *late_ns, order);
    const char *fifo = sched_getscheduler(0) == SCHED_FIFO ? "true" : "false";
    printf("{\"edges\": %zu, \"missed\": %" PRIu64 ", \"fifo\": %s, \"late_ns\": [", edges, missed, fifo);
    for (size_t k = 0; k < edges && k < MOST_VALUES; k++) /* the least and the greatest are always among them */
        printf("%s%" PRId64, k ? ", " : "", late_ns[edges > MOST_VALUES ? k * (edges - 1) / (MOST_VALUES - 1) : k]);
    puts("]}");
    free(late_ns);
    return 0;
}
