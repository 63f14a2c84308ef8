/* plant.c - see fw_plant.h. To be read beside sim/plant.py: same names, same order of operations, same comments left out. */
#include "fw_plant.h"

#include <math.h>
#include <string.h>

#include "trig.h"

static const double GRAVITY_MPS2 = 9.81;
static const double CREEP2_M2PS2 = 0.1 * 0.1;

/* The side force of an axle (Fiala). */
static double fiala_force_n(double slip, double stiffness_nprad, double limit_n) {
    double sliding = 3.0 * limit_n / stiffness_nprad;
    if (slip >= sliding) return limit_n;
    if (slip <= -sliding) return -limit_n;
    double part = (slip >= 0.0 ? slip : -slip) / sliding;
    return stiffness_nprad * slip * (1.0 - part + part * part / 3.0);
}

/* cos(theta) of the contact's velocity against the wheel plane. */
static double slide_cosine(double roll_mps, double side_mps) {
    double roll2 = roll_mps * roll_mps + CREEP2_M2PS2;
    return sqrt(roll2 / (roll2 + side_mps * side_mps));
}

void fw_step_cart(fw_cart *s, const fw_demand *demand, const fw_ground *ground, const fw_coefficients *k) {
    double dt = k->dt_s;
    double mass = k->mass_kg;
    double vx = s->vx_mps;
    double vy_C = s->vy_mps;
    double r = s->yaw_rate_radps;
    double yaw = s->yaw_rad;

    /* 1. Actuators */
    double limit = k->max_steer_rad;
    double target = demand->steer_rad > limit ? limit : demand->steer_rad < -limit ? -limit : demand->steer_rad;
    double change = k->steer_gain * (target - s->steer_rad);
    limit = k->max_steer_step_rad;
    change = change > limit ? limit : change < -limit ? -limit : change;
    double steer = s->steer_rad + change;
    target = demand->brake > 1.0 ? 1.0 : demand->brake < 0.0 ? 0.0 : demand->brake;
    double brake = s->brake + k->brake_gain * (target - s->brake);
    double drive = 0.0;
    if (demand->contactor_open == 0.0) {
        target = demand->drive > 1.0 ? 1.0 : demand->drive < -1.0 ? -1.0 : demand->drive;
        drive = s->drive + k->drive_gain * (target - s->drive);
    }

    /* 2. Axle loads */
    double steer_sin, steer_cos;
    fw_sincos(steer, &steer_sin, &steer_cos);
    double grade_x = ground->grade_x;
    double grade_y = ground->grade_y;
    double weight_n = mass * GRAVITY_MPS2 / sqrt(1.0 + grade_x * grade_x + grade_y * grade_y);
    double shift_n = mass * s->ax_mps2 * k->transfer;
    double front_load_n = weight_n * k->front_share - shift_n;
    double rear_load_n = weight_n * k->rear_share + shift_n;
    front_load_n = front_load_n > 0.0 ? front_load_n : 0.0;
    rear_load_n = rear_load_n > 0.0 ? rear_load_n : 0.0;
    double friction = k->friction * ground->friction_factor;
    double front_limit_n = friction * front_load_n;
    double rear_limit_n = friction * rear_load_n;

    /* 3. Slip */
    double front_y = vy_C + (k->a_m + k->b_m) * r;
    double front_roll = vx * steer_cos + front_y * steer_sin;
    double front_side = front_y * steer_cos - vx * steer_sin;
    double per_length = dt / k->relaxation_m;
    double speed = front_roll >= 0.0 ? front_roll : -front_roll;
    double front_slip = (s->front_slip - per_length * front_side) / (1.0 + per_length * speed);
    limit = 3.0 * front_limit_n / k->front_stiffness_nprad;
    front_slip = front_slip > limit ? limit : front_slip < -limit ? -limit : front_slip;
    speed = vx >= 0.0 ? vx : -vx;
    double rear_slip = (s->rear_slip - per_length * vy_C) / (1.0 + per_length * speed);
    limit = 3.0 * rear_limit_n / k->rear_stiffness_nprad;
    rear_slip = rear_slip > limit ? limit : rear_slip < -limit ? -limit : rear_slip;
    double damping = 0.0;
    if (speed < k->parking_speed_mps) {
        double fade = 1.0 - speed / k->parking_speed_mps;
        damping = k->parking_damping_spm * fade * fade;
    }

    /* 4. Turning */
    double vy = vy_C + k->b_m * r;
    double half = 0.5 * r * dt;
    double scale = 1.0 / (1.0 + half * half);
    double turn_cos = (1.0 - half * half) * scale;
    double turn_sin = 2.0 * half * scale;
    double vx_turned = vx * turn_cos + vy * turn_sin;
    double vy_turned = vy * turn_cos - vx * turn_sin;

    /* 5. Along x */
    double front_grip_n = front_limit_n * slide_cosine(front_roll, front_side);
    double rear_grip_n = rear_limit_n * slide_cosine(vx, vy_C);
    double drive_n = drive * k->drive_force_n;
    double top = drive >= 0.0 ? k->max_speed_mps : k->max_reverse_speed_mps;
    double room = (top - (drive >= 0.0 ? vx : -vx)) / k->speed_taper_mps;
    drive_n = drive_n * (room < 0.0 ? 0.0 : room < 1.0 ? room : 1.0);
    if ((drive_n >= 0.0 ? drive_n : -drive_n) * speed > k->drive_power_w)
        drive_n = (drive_n >= 0.0 ? k->drive_power_w : -k->drive_power_w) / speed;
    drive_n = drive_n > rear_grip_n ? rear_grip_n : drive_n < -rear_grip_n ? -rear_grip_n : drive_n;
    double yaw_sin, yaw_cos;
    fw_sincos(yaw, &yaw_sin, &yaw_cos);
    double slope_x_n = -weight_n * (grade_x * yaw_cos + grade_y * yaw_sin);
    double slope_y_n = -weight_n * (grade_y * yaw_cos - grade_x * yaw_sin);
    double drag_n = k->drag_kgpm * vx * speed;
    double push_n = mass * vx_turned / dt + drive_n + slope_x_n - drag_n;
    double ahead = push_n >= 0.0 ? 1.0 : -1.0;
    double front_brake_n = brake * k->front_brake_n;
    front_brake_n = front_brake_n > front_grip_n ? front_grip_n : front_brake_n;
    double rear_brake_n = brake * k->rear_brake_n;
    double grip_n = rear_grip_n + ahead * drive_n;
    int brake_locks = rear_brake_n > grip_n;
    rear_brake_n = brake_locks ? grip_n : rear_brake_n;
    double dry_n = rear_brake_n + front_brake_n * steer_cos + k->rolling_resistance * weight_n;
    double need_n = ahead * push_n;
    double used = need_n >= dry_n ? ahead : ahead * need_n / dry_n;
    double front_x_n = -used * front_brake_n;
    double rear_x_n = drive_n - used * rear_brake_n;

    /* 6. Across */
    double left = front_limit_n * front_limit_n - front_x_n * front_x_n;
    double left_n = left > 0.0 ? sqrt(left) : 0.0;
    double front_y_n = fiala_force_n(front_slip - damping * front_side, k->front_stiffness_nprad, left_n);
    left = rear_limit_n * rear_limit_n - rear_x_n * rear_x_n;
    left_n = left > 0.0 ? sqrt(left) : 0.0;
    double rear_y_n = fiala_force_n(rear_slip - damping * vy_C, k->rear_stiffness_nprad, left_n);

    /* 7. Velocity */
    double side_x_n = front_y_n * steer_sin;
    push_n = push_n - side_x_n;
    double force_x_n, vx_new;
    if (push_n > dry_n) {
        force_x_n = drive_n - drag_n - side_x_n - dry_n;
        vx_new = vx_turned + dt * (force_x_n + slope_x_n) / mass;
    } else if (push_n < -dry_n) {
        force_x_n = drive_n - drag_n - side_x_n + dry_n;
        vx_new = vx_turned + dt * (force_x_n + slope_x_n) / mass;
    } else {
        force_x_n = -mass * vx_turned / dt - slope_x_n;
        vx_new = 0.0;
    }
    double front_across_n = front_y_n * steer_cos + front_x_n * steer_sin;
    double force_y_n = front_across_n + rear_y_n;
    double vy_new = vy_turned + dt * (force_y_n + slope_y_n) / mass;
    double r_new = r + dt * (k->a_m * front_across_n - k->b_m * rear_y_n) / k->yaw_inertia_kgm2;
    double vy_C_new = vy_new - k->b_m * r_new;

    /* 7. Pose, with the yaw of mid-step */
    double yaw_change = r_new * dt;
    double yaw_middle = yaw + 0.5 * yaw_change;
    fw_sincos(yaw_middle, &yaw_sin, &yaw_cos);
    int locked = brake_locks && need_n > dry_n;
    if (!locked) {
        double differential = r_new * k->half_track_m;
        s->left_travel_m = s->left_travel_m + (vx_new - differential) * dt;
        s->right_travel_m = s->right_travel_m + (vx_new + differential) * dt;
    }
    s->x_m = s->x_m + (vx_new * yaw_cos - vy_C_new * yaw_sin) * dt;
    s->y_m = s->y_m + (vx_new * yaw_sin + vy_C_new * yaw_cos) * dt;
    s->yaw_rad = yaw + yaw_change;
    s->vx_mps = vx_new;
    s->vy_mps = vy_C_new;
    s->yaw_rate_radps = r_new;
    s->steer_rad = steer;
    s->brake = brake;
    s->drive = drive;
    s->front_slip = front_slip;
    s->rear_slip = rear_slip;
    s->ax_mps2 = force_x_n / mass;
    s->ay_mps2 = force_y_n / mass;
    s->distance_m = s->distance_m + sqrt(vx_new * vx_new + vy_C_new * vy_C_new) * dt;
    s->rear_locked = locked;
}

/* -- N carts ---------------------------------------------------------------------------------------------------- */

size_t fw_plant_size(uint64_t n, uint64_t depth) {
    if (n == 0 || depth == 0 || depth > FW_DEPTH_MAX) return 0;
    size_t row = sizeof(fw_cart) + depth * sizeof(fw_demand);
    if (n > (PTRDIFF_MAX - sizeof(fw_plant)) / row) return 0;
    return sizeof(fw_plant) + n * row;
}

void fw_plant_init(fw_plant *plant, uint64_t n, uint64_t depth) {
    memset(plant, 0, fw_plant_size(n, depth));
    *plant = (fw_plant){.magic = FW_PLANT_MAGIC, .n = n, .depth = depth};
}

fw_cart *fw_plant_carts(fw_plant *plant) { return (fw_cart *)(plant + 1); }

fw_demand *fw_plant_pending(fw_plant *plant, uint64_t cart) {
    return (fw_demand *)(fw_plant_carts(plant) + plant->n) + cart * plant->depth;
}

/* Where in a ring of `depth` the demand of `delay` steps before `now` stands. */
static uint64_t ago(uint64_t now, uint64_t delay, uint64_t depth) { return now >= delay ? now - delay : now + depth - delay; }

uint64_t fw_plant_step(fw_plant *plant, const fw_params *params, const fw_demand *demand, const fw_ground *ground, uint64_t steps) {
    uint64_t depth = plant->depth, beyond = 0;
    for (uint64_t i = 0; i < plant->n; i++) { /* all steps of one cart: its row stays in the cache */
        const fw_params *p = &params[i];
        fw_cart *s = fw_plant_carts(plant) + i;
        fw_demand *pending = fw_plant_pending(plant, i);
        uint64_t now = plant->newest;
        int far = 0;
        for (uint64_t step = 0; step < steps; step++) {
            now = now + 1 == depth ? 0 : now + 1;
            pending[now] = demand[i];
            far = s->yaw_rad > FW_YAW_MAX || s->yaw_rad < -FW_YAW_MAX;
            if (far) continue;
            fw_demand due = {
                .steer_rad = pending[ago(now, p->steer_delay, depth)].steer_rad,
                .brake = pending[ago(now, p->brake_delay, depth)].brake,
                .drive = pending[ago(now, p->drive_delay, depth)].drive,
                .contactor_open = demand[i].contactor_open,
            };
            fw_step_cart(s, &due, &ground[i], &p->k);
        }
        beyond += (uint64_t)far;
    }
    plant->newest = (plant->newest + steps % depth) % depth;
    return beyond;
}
