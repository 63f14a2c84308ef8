/* Be the component `follow`: steer from way-point to way-point of parking-lot/square.
 *
 *     cc -O2 -o steer steer.c -lm && ./steer MOUNT_POINT
 *
 * The files stay open. A stat of the clock says "done", and returns in the next cycle; a read from 0 is one revision,
 * a write at 0 is the next.
 */
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static double of(const char *json, const char *key) /* the number behind a key; the pose comes first */
{
    const char *at = strstr(json, key);
    return at ? atof(at + strlen(key)) : 0.0;
}

int main(int argc, char **argv)
{
    static const double x[] = {15, 15, -15, -15}, y[] = {-15, 15, 15, -15};
    static char text[65536];
    if (argc != 2 || chdir(argv[1]))
        return fprintf(stderr, "usage: steer MOUNT_POINT\n"), 2;
    int clock = open("follow/clock", O_RDONLY), pose = open("localise/status", O_RDONLY);
    int drive = open("follow/status", O_WRONLY), k = 0;
    struct stat edge;
    while (fstat(clock, &edge) == 0) { /* done with this cycle; now it is the next */
        ssize_t n = pread(pose, text, sizeof text - 1, 0);
        text[n > 0 ? n : 0] = 0;
        double dx = k < 4 ? x[k] - of(text, "\"x_m\":") : 1, dy = k < 4 ? y[k] - of(text, "\"y_m\":") : 0;
        if (k < 4 && hypot(dx, dy) < 3.2)
            k++;
        double turn = remainder(atan2(dy, dx) - of(text, "\"yaw_rad\":"), 2 * M_PI);
        double steer_rad = fmax(-0.46, fmin(0.46, turn)), speed_mps = k == 4 ? 0 : fabs(steer_rad) < 0.2 ? 3 : 2;
        n = snprintf(text, sizeof text,
                     "{\"drive\": {\"speed_mps\": %g, \"steer_rad\": %.4f, \"decel_mps2\": 1}, \"state\": {\"finished\": %s}}\n",
                     speed_mps, steer_rad, k == 4 ? "true" : "false");
        if (pwrite(drive, text, n, 0) != n)
            break;
    }
    perror("steer");
    return 1;
}
