/* The surfels of a map, as its files hold them and as numbers. kernel.py has the same structures: PACKED_SURFEL, SURFEL, CUBE. */
#ifndef STREETFIX_SURFEL_H
#define STREETFIX_SURFEL_H
#include <math.h>
#include <stdint.h>

#include "../layout.h"

#define STEPS 1024        /* steps of a packed position along the edge of a cell */
#define CUBE_STEPS 65536  /* steps along the edge of a region: 64 cells */
#define NORMAL_BITS 12    /* bits of each number of a packed normal */
#define NORMAL_STEPS 2047 /* steps of such a number from 0 to 1 */
#define THICKNESS_M 1.6e-5f /* thickness of code 1; the thickness grows with the square of the code */
#define POINTS_LOG 0.0875 /* natural logarithm of the ratio between two codes of the number of points; code 1 is one point */

/* A surfel as numbers: metres in the surfels' frame, unit normal. */
typedef struct {
    float xyz[3], normal[3], thickness_m;
    uint32_t points;
} Surfel;

/* A surfel as a map holds it, in 11 bytes. Its position counts from the corner of its region. */
typedef struct __attribute__((packed)) {
    uint16_t xyz[3];           /* steps; STEPS along the edge of a cell */
    uint8_t normal
        [3]; /* octahedral map of the unit vector (Meyer et al. 2010): two signed numbers of NORMAL_BITS, the first in the lower bits */
    uint8_t thickness, points; /* codes: the root of the thickness, the logarithm of the number of points; 0 is 0 */
} PackedSurfel;

/* The surfels of a region. */
typedef struct {
    double corner[3]; /* surfels' frame, m */
    int64_t first, count; /* rows in the surfels of the map */
} Cube;

#define SURFEL_LAYOUT                                                                                                                   \
    LAYOUT_STRUCT(Surfel), LAYOUT_FIELD(Surfel, xyz), LAYOUT_FIELD(Surfel, normal), LAYOUT_FIELD(Surfel, thickness_m),                  \
        LAYOUT_FIELD(Surfel, points), LAYOUT_STRUCT(PackedSurfel), LAYOUT_FIELD(PackedSurfel, xyz), LAYOUT_FIELD(PackedSurfel, normal), \
        LAYOUT_FIELD(PackedSurfel, thickness), LAYOUT_FIELD(PackedSurfel, points), LAYOUT_STRUCT(Cube), LAYOUT_FIELD(Cube, corner),     \
        LAYOUT_FIELD(Cube, first), LAYOUT_FIELD(Cube, count)

/* The two numbers of a packed normal. */
static inline void normal_pair(const uint8_t packed[3], int32_t pair[2])
{
    const uint32_t bits = (uint32_t)packed[0] | (uint32_t)packed[1] << 8 | (uint32_t)packed[2] << 16;
    pair[0] = (int32_t)(bits << (32 - NORMAL_BITS)) >> (32 - NORMAL_BITS);
    pair[1] = (int32_t)(bits << (32 - 2 * NORMAL_BITS)) >> (32 - NORMAL_BITS);
}

/* Unit vector of a packed normal. */
static inline void unpack_normal(const uint8_t packed[3], float normal[3])
{
    int32_t pair[2];
    normal_pair(packed, pair);
    const float x = (float)pair[0], y = (float)pair[1], z = (float)NORMAL_STEPS - fabsf(x) - fabsf(y), fold = z < 0 ? -z : 0.0f;
    const float ux = x + (x < 0 ? fold : -fold), uy = y + (y < 0 ? fold : -fold);
    const float scale = 1.0f / sqrtf(ux * ux + uy * uy + z * z);
    normal[0] = ux * scale, normal[1] = uy * scale, normal[2] = z * scale;
}

static inline float unpack_thickness(uint8_t code)
{
    return THICKNESS_M * (float)(code * code);
}

#endif
