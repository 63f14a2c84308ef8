/* Generated from examples.roadtracker_records: python -m rtdb.c_header examples.roadtracker_records */

#ifndef EXAMPLES_ROADTRACKER_RECORDS_H
#define EXAMPLES_ROADTRACKER_RECORDS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
#define _Alignas alignas
#define _Static_assert static_assert
#endif

/* A grey picture of the road ahead. */
typedef struct {
    _Alignas(8) uint32_t pixels_h;
    uint32_t pixels_w;
    uint32_t pixels_c;
    uint8_t pixels[48][64][1]; /* brightness, top row first */
} fw_CameraFrame;
_Static_assert(sizeof(fw_CameraFrame) == 3088, "CameraFrame");

/* Where the lane is, as seen from the cart. */
typedef struct {
    _Alignas(8) double offset_m; /* [m] of the lane's middle to the left of the cart's */
    double heading_rad; /* [rad] of the lane to the left of the cart's */
} fw_Lane;
_Static_assert(sizeof(fw_Lane) == 16, "Lane");

#define FW_CAMERAFRAME_SCHEMA \
    "{\"name\":\"CameraFrame\",\"doc\":\"A grey picture of the road ahead.\",\"size\":3088,\"fields\":[{\"name\":\"pixels\",\"kind\":\"image\",\"unit\":\"\",\"doc\":\"brightness, top row first\",\"n\":3072,\"shape\":\"one\",\"number\":1,\"values\":{},\"extent\":[48,64,1]}]}"

#define FW_LANE_SCHEMA \
    "{\"name\":\"Lane\",\"doc\":\"Where the lane is, as seen from the cart.\",\"size\":16,\"fields\":[{\"name\":\"offset_m\",\"kind\":\"f8\",\"unit\":\"m\",\"doc\":\"of the lane's middle to the left of the cart's\",\"n\":1,\"shape\":\"one\",\"number\":1,\"values\":{}},{\"name\":\"heading_rad\",\"kind\":\"f8\",\"unit\":\"rad\",\"doc\":\"of the lane to the left of the cart's\",\"n\":1,\"shape\":\"one\",\"number\":2,\"values\":{}}]}"

#endif
