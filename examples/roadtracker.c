/* roadtracker.c - the road tracker of the KogMo-RTDB paper (its figure 5) on this store: wait for the camera, follow its
 * pictures one by one, write the lane. `roadtracker.py` is the same program in Python.
 *
 *   cc -std=c11 -O2 -Irtdb/core examples/roadtracker.c rtdb/core/?*.c -pthread -o roadtracker
 *   ./roadtracker STORE [FRAMES]
 */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fw_rtdb.h"
#include "roadtracker.h"

#define WIDTH_M 3.2    /* of road that the picture's width shows */
#define DEPTH_M 4.8    /* and its height */
#define SECOND 1000000000LL

/* The lane is the bright stripe: the middle of each row's brightness, and the line through these middles. */
static fw_Lane track(const fw_CameraFrame *frame) {
    double n = 0, sy = 0, sx = 0, syy = 0, sxy = 0;
    for (uint32_t row = 0; row < frame->pixels_h; row++) {
        double bright = 0, moment = 0;
        for (uint32_t column = 0; column < frame->pixels_w; column++) {
            bright += frame->pixels[row][column][0];
            moment += frame->pixels[row][column][0] * (column + 0.5);
        }
        if (bright == 0) continue;
        double y = (frame->pixels_h - 0.5 - row) * DEPTH_M / frame->pixels_h;            /* ahead */
        double x = (0.5 - moment / bright / frame->pixels_w) * WIDTH_M;                  /* to the left */
        n += 1, sy += y, sx += x, syy += y * y, sxy += x * y;
    }
    double slope = n > 1 ? (n * sxy - sx * sy) / (n * syy - sy * sy) : 0;
    return (fw_Lane){.offset_m = n > 0 ? (sx - slope * sy) / n : 0, .heading_rad = slope};
}

static int fail(const char *what, int64_t r) {
    fprintf(stderr, "roadtracker: %s: %s\n", what, strerror((int)-r));
    return 1;
}

int main(int argc, char **argv) {
    if (argc < 2) { fprintf(stderr, "usage: roadtracker STORE [FRAMES]\n"); return 2; }
    long frames = argc > 2 ? atol(argv[2]) : 0;
    fw_db *db;
    int r = fw_attach(&db, argv[1]);
    if (r < 0) return fail("attach", r);

    int me = fw_join(db, "roadtracker", &(fw_join_opts){.version = "1"});
    if (me < 0) return fail("join", me);
    int schema = fw_schema_add(db, FW_LANE_SCHEMA, sizeof FW_LANE_SCHEMA - 1);
    fw_spec spec = {.name = "roadtracker/lane", .schema = (uint32_t)schema, .size = sizeof(fw_Lane), .n_slots = 64,
                    .every = 1, .n_causes = 1, .component = (uint32_t)me};
    fw_handle lane = fw_find(db, spec.name); /* of a predecessor */
    if (lane < 0) lane = fw_insert(db, &spec);
    if (lane < 0) return fail("insert", lane);

    fw_handle camera;
    for (;;) { /* no order of starting: the camera may come later */
        uint64_t version = fw_directory_version(db);
        if ((camera = fw_find(db, "camera/left")) >= 0) break;
        r = fw_wait_directory(db, version, 10 * SECOND);
        if (r < 0) return fail("wait for camera/left", r);
    }
    fw_object about;
    if ((r = fw_object_get(db, camera, &about)) < 0) return fail("camera/left", r);

    uint64_t seen = 0, lost;
    for (long k = 0; frames == 0 || k < frames; k++) {
        int64_t w = fw_wait_write(db, camera, seen, fw_now_ns(db) + 10 * SECOND);
        if (w >= 0) w = fw_next(db, camera, seen, &lost);
        if (w == -EIDRM) break; /* the camera was deleted */
        if (w < 0) return fail("wait for a picture", w);
        if (lost) fprintf(stderr, "roadtracker: %llu pictures lost\n", (unsigned long long)lost);
        seen = (uint64_t)w;

        const void *frame; /* in place: nothing is copied */
        fw_info info;
        if (fw_peek(db, camera, seen, &frame, &info) < 0) continue;
        fw_Lane found = track(frame);
        if (fw_check(db, camera, seen) < 0) continue; /* the camera came around while we looked */

        fw_cause cause = {about.oid, seen};
        int64_t t = fw_not_before(db, lane, info.t_data_ns); /* true when the picture was taken */
        if ((w = fw_write(db, lane, &found, sizeof found, t, &cause, 1)) < 0) return fail("write", w);
        fw_done(db, (uint32_t)me, fw_cycle(db));
    }
    fw_close(db);
    return 0;
}
