/* trig.h - sine, cosine and arc tangent with the same bits on every machine.
 *
 * The C library's differ in the last bit from version to version, and even from processor to processor. These use only
 * + - * / in the order written, and have to be compiled with -ffp-contract=off and without -ffast-math. The result is less
 * than 1 ulp (a unit of its last place) from the true value; tests/sim/test_compiled_plant.py measures it. */
#ifndef FW_TRIG_H
#define FW_TRIG_H

#define FW_TRIG_MAX 102900.0 /* rad: 65,500 quarter turns */

/* Writes sine and cosine of x in [-FW_TRIG_MAX, FW_TRIG_MAX], and NaN for everything else, NaN included. */
void fw_sincos(double x, double *sine, double *cosine);

/* Returns the angle in [-pi/2, pi/2] with the tangent x; NaN for NaN. The step does not need it; who turns a velocity or a
 * slope of the plant into an angle does. */
double fw_atan(double x);

#endif
