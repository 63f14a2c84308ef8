/* trig.c - see trig.h. The polynomials are plain Taylor series, short because the argument is made small first: nothing to
 * look up, and two terms longer than the best approximation would be. */
#include "trig.h"

#include <math.h> /* NAN; nothing of it is called */

/* pi/2 in three parts. The first two have 37 bits, so that their products with a number of 16 bits are exact; together
 * they are within 2^-127 of it. (Cody and Waite, Software Manual for the Elementary Functions, 1980) */
static const double HALF_PI_1 = 0x1.921fb54440000p+0;
static const double HALF_PI_2 = 0x1.68c234c4c0000p-39;
static const double HALF_PI_3 = 0x1.98a2e03707345p-77;
static const double PER_HALF_PI = 0x1.45f306dc9c883p-1; /* 2/pi */

static const double TINY = 0x1p-27; /* below, sin x and atan x are x: the next term is less than a third of an ulp */

/* Writes x - n pi/2 as the sum of two doubles, and returns n, the whole number of quarter turns nearest to x. The difference
 * may cancel down to 1e-17, so what each subtraction rounds away is kept (Knuth's two-sum). */
static int quarter_turns(double x, double *rest, double *tail) {
    int n = (int)(x * PER_HALF_PI + (x < 0.0 ? -0.5 : 0.5));
    double first = x - n * HALF_PI_1; /* exact: the two are close to each other */
    double second = n * HALF_PI_2;
    double difference = first - second;
    double back = difference - first;
    double lost = (first - (difference - back)) - (second + back);
    lost = lost - n * HALF_PI_3;
    *rest = difference + lost;
    back = *rest - difference;
    *tail = (difference - (*rest - back)) + (lost - back);
    return n;
}

/* Sine of r + tail with |r| <= pi/4; the first term left out, r^19/19!, is below 2^-63 of the result. */
static double sine_of(double r, double tail) {
    double z = r * r;
    double sum = 1.0 / 355687428096000.0;
    sum = -1.0 / 1307674368000.0 + z * sum;
    sum = 1.0 / 6227020800.0 + z * sum;
    sum = -1.0 / 39916800.0 + z * sum;
    sum = 1.0 / 362880.0 + z * sum;
    sum = -1.0 / 5040.0 + z * sum;
    sum = 1.0 / 120.0 + z * sum;
    sum = -1.0 / 6.0 + z * sum;
    return r + (r * z * sum + tail * (1.0 - 0.5 * z));
}

/* Cosine of r + tail; the first term left out, r^18/18!, is below 2^-58. What 1 - z/2 rounds away is added again. */
static double cosine_of(double r, double tail) {
    double z = r * r;
    double sum = 1.0 / 20922789888000.0;
    sum = -1.0 / 87178291200.0 + z * sum;
    sum = 1.0 / 479001600.0 + z * sum;
    sum = -1.0 / 3628800.0 + z * sum;
    sum = 1.0 / 40320.0 + z * sum;
    sum = -1.0 / 720.0 + z * sum;
    sum = 1.0 / 24.0 + z * sum;
    double half = 0.5 * z;
    double most = 1.0 - half;
    return most + (((1.0 - most) - half) + (z * z * sum - r * tail));
}

void fw_sincos(double x, double *sine, double *cosine) {
    if (!(x >= -FW_TRIG_MAX && x <= FW_TRIG_MAX)) {
        *sine = *cosine = NAN;
        return;
    }
    if (x > -TINY && x < TINY) { /* keeps the sign of -0 */
        *sine = x;
        *cosine = 1.0;
        return;
    }
    double r, tail;
    int n = quarter_turns(x, &r, &tail);
    double s = sine_of(r, tail), c = cosine_of(r, tail);
    switch (n & 3) {
    case 0: *sine = s, *cosine = c; break;
    case 1: *sine = c, *cosine = -s; break;
    case 2: *sine = -s, *cosine = -c; break;
    default: *sine = -c, *cosine = s; break;
    }
}

/* atan(k/8) for k = 0 to 8, then atan(8/k) for k = 7 to 0, each as the sum of two doubles. */
static const double ANCHOR[17][2] = {
    {0x0.0p+0, 0x0.0p+0},
    {0x1.fd5ba9aac2f6ep-4, -0x1.cd37686760c17p-59},
    {0x1.f5b75f92c80ddp-3, 0x1.8ab6e3cf7afbdp-57},
    {0x1.6f61941e4def1p-2, -0x1.c63aae6f6e918p-56},
    {0x1.dac670561bb4fp-2, 0x1.a2b7f222f65e2p-56},
    {0x1.1e00babdefeb4p-1, -0x1.928df287a668fp-58},
    {0x1.4978fa3269ee1p-1, 0x1.2419a87f2a458p-56},
    {0x1.700a7c5784634p-1, -0x1.8c34d25aadef6p-56},
    {0x1.921fb54442d18p-1, 0x1.1a62633145c07p-55},
    {0x1.b434ee31013fdp-1, -0x1.0520d0701d877p-55},
    {0x1.dac670561bb4fp-1, 0x1.a2b7f222f65e2p-55},
    {0x1.031f57e54adbep+0, 0x1.338b4259c0270p-54},
    {0x1.1b6e192ebbe44p+0, 0x1.b1b466a88828ep-54},
    {0x1.3647503caf55cp+0, 0x1.17e21d9a42c9ap-55},
    {0x1.5368c951e9cfdp+0, -0x1.96f47948a99f1p-54},
    {0x1.7249faa996a21p+0, 0x1.a8cc1e7480c68p-54},
    {0x1.921fb54442d18p+0, 0x1.1a62633145c07p-54},
};

/* atan a - atan b = atan((a - b) / (1 + a b)) with b the nearest anchor: at most 1/16 is left for the series. The quotient d is
 * written so that what rounds is small against the result; d - most is added late for the same reason. */
double fw_atan(double x) {
    double size = x < 0.0 ? -x : x;
    if (!(size >= TINY)) return x; /* keeps the sign of -0, and NaN */
    if (size > 0x1p60) return x < 0.0 ? -ANCHOR[16][0] : ANCHOR[16][0];
    int k;
    double most, less;
    if (size <= 1.0) {
        k = (int)(8.0 * size + 0.5);
        double b = k / 8.0;
        most = size - b; /* exact */
        less = -most * (size * b / (1.0 + size * b));
    } else {
        k = (int)(8.0 / size + 0.5);
        double b = k / 8.0; /* the anchor is 1/b, and this (b size - 1) / (size + b) */
        most = (b * (size - 1.0) - (1.0 - b)) / (size + b);
        less = 0.0;
        k = 16 - k;
    }
    double d = most + less;
    double z = d * d;
    double sum = 1.0 / 13.0;
    sum = -1.0 / 11.0 + z * sum;
    sum = 1.0 / 9.0 + z * sum;
    sum = -1.0 / 7.0 + z * sum;
    sum = 1.0 / 5.0 + z * sum;
    sum = -1.0 / 3.0 + z * sum;
    double angle = ANCHOR[k][0] + (most + (ANCHOR[k][1] + (less + d * z * sum)));
    return x < 0.0 ? -angle : angle;
}
