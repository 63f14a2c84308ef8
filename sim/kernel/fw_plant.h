/* fw_plant.h - the planar cart over N carts: the kernel of the equations in sim/plant.py, and its manual.
 *
 * sim/plant.py is the readable form, with the sources of the model. plant.c does the same operations in the same order, so
 * both give the same bits from the same sines and cosines. Those come from trig.h here and from the C library there, and
 * differ in the last bit now and then: one step from the same state agrees within 1e-12. tests/sim/test_compiled_plant.py
 * checks both.
 *
 * Same bits on every x86-64 machine and from every compiler that keeps to IEEE 754, if compiled with -ffp-contract=off (no
 * a * b + c in one rounding) and without -ffast-math. sqrt, which IEEE 754 defines to the last bit, is an instruction with
 * -fno-math-errno; nothing else of the mathematical library is used.
 *
 * A plant is one block of memory without pointers in it, of fw_plant_size bytes, aligned to 8. Copying it saves it, copying it
 * back restores it, in any process of the same layout.
 *
 *   byte 0         fw_plant                            32           magic, n, depth, newest
 *   32             fw_cart    carts[n]                136 n         what CartState holds: 17 doubles per cart
 *   32 + 136 n     fw_demand  pending[n][depth]        32 n depth   demands under way: a ring per cart
 *
 *   ring:   index    ...   newest - 1   newest      newest + 1              modulo depth, the same for every cart
 *           demand         last step's  this step's of depth - 1 steps ago
 *
 * The caller owns every array and the kernel keeps none of the pointers. Units are in the names; frames, signs and meanings
 * stand beside the fields of the same names in sim/plant.py. No allocation, no globals, no locks: two threads may step two
 * plants, not one. */
#ifndef FW_PLANT_H
#define FW_PLANT_H

#include <stddef.h>
#include <stdint.h>

#define FW_PLANT_MAGIC 0x31544e414c505746ull /* "FWPLANT1" */
#define FW_DEPTH_MAX 4096u                   /* demands under way per cart: 20 s at 5 ms */
#define FW_YAW_MAX 1e5                       /* rad, 15,900 turns one way: less than FW_TRIG_MAX by what a step may add */

/* CartState. A state is a row of doubles, so that N of them are a matrix. */
typedef struct {
    double x_m, y_m, yaw_rad;
    double vx_mps, vy_mps, yaw_rate_radps;
    double steer_rad, brake, drive;
    double front_slip, rear_slip;
    double ax_mps2, ay_mps2;
    double left_travel_m, right_travel_m, distance_m;
    double rear_locked; /* 0 or 1 */
} fw_cart;

/* Demand. */
typedef struct {
    double steer_rad, brake, drive;
    double contactor_open; /* 0 or not */
} fw_demand;

/* Ground. */
typedef struct {
    double grade_x, grade_y, friction_factor;
} fw_ground;

/* Coefficients: Python computes them once, see sim.plant.coefficients. */
typedef struct {
    double dt_s, mass_kg, yaw_inertia_kgm2, a_m, b_m, front_share, rear_share, transfer, half_track_m;
    double front_stiffness_nprad, rear_stiffness_nprad, friction, relaxation_m, parking_damping_spm, parking_speed_mps;
    double front_brake_n, rear_brake_n, rolling_resistance, drag_kgpm;
    double drive_force_n, drive_power_w, max_speed_mps, max_reverse_speed_mps, speed_taper_mps;
    double steer_gain, brake_gain, drive_gain, max_steer_rad, max_steer_step_rad;
} fw_coefficients;

/* What one cart is like. Dead times are whole steps, each less than the plant's depth. */
typedef struct {
    fw_coefficients k;
    uint32_t steer_delay, brake_delay, drive_delay, unused;
} fw_params;

typedef struct {
    uint64_t magic;
    uint64_t n, depth; /* carts; demands kept per cart: 1 + the longest dead time of any of them */
    uint64_t newest;   /* where in each ring this step's demand stands */
} fw_plant;

/* Returns the bytes that a plant needs, 0 if it cannot be: n or depth is 0, depth > FW_DEPTH_MAX, or too large for memory. */
size_t fw_plant_size(uint64_t n, uint64_t depth);

/* Makes fw_plant_size(n, depth) > 0 bytes a plant: carts at rest in the origin, demands all zero. */
void fw_plant_init(fw_plant *plant, uint64_t n, uint64_t depth);

/* Return where the rows begin: n carts; the ring of one cart, cart < n. Good as long as the plant's memory is. */
fw_cart *fw_plant_carts(fw_plant *plant);
fw_demand *fw_plant_pending(fw_plant *plant, uint64_t cart);

/* Advances cart i by `steps` steps of params[i].k.dt_s under demand[i] on ground[i], for every i < n. An open contactor acts
 * at once, everything else after its dead time.
 *
 * Returns the number of carts whose yaw is beyond FW_YAW_MAX: such a cart stands where it was before that step, the others go
 * on. It fails in no other way. Inputs must be finite (a demand may be infinite, it is clipped), else the cart's state becomes
 * NaN, as in sim/plant.py; the other carts never notice. */
uint64_t fw_plant_step(fw_plant *plant, const fw_params *params, const fw_demand *demand, const fw_ground *ground, uint64_t steps);

/* Advances one cart by one step. The demand is that at the actuators: dead times are over. `s` is read, then written. */
void fw_step_cart(fw_cart *s, const fw_demand *demand, const fw_ground *ground, const fw_coefficients *k);

#endif
