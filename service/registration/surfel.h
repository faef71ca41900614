/* The surfels of a map, as its files hold them and as numbers. kernel.py has the same structures: PACKED_SURFEL, SURFEL, CUBE. */
#ifndef STREETFIX_SURFEL_H
#define STREETFIX_SURFEL_H
#include <math.h>
#include <stdint.h>

#include "../layout.h"

#define STEPS 1024        /* steps of a packed position along the edge of a cell */
#define CUBE_STEPS 65536  /* steps along the edge of a region: 64 cells */
#define NORMAL_STEPS 32767
#define THICKNESS_M 1.6e-5f /* thickness of code 1; the thickness grows with the square of the code */
#define POINTS_LOG 0.0875 /* natural logarithm of the ratio between two codes of the number of points; code 1 is one point */

/* A surfel as numbers: metres in the surfels' frame, unit normal. */
typedef struct {
    float xyz[3], normal[3], thickness_m;
    uint32_t points;
} Surfel;

/* A surfel as a map holds it. Its position counts from the corner of its region. */
typedef struct {
    uint16_t xyz[3];           /* steps; STEPS along the edge of a cell */
    int16_t normal[2];         /* octahedral map of the unit vector (Meyer et al. 2010), NORMAL_STEPS from 0 to 1 */
    uint8_t thickness, points; /* codes: the root of the thickness, the logarithm of the number of points; 0 is 0 */
} PackedSurfel;

/* The surfels of a region. */
typedef struct {
    double corner[3];     /* surfels' frame, m */
    int64_t first, count; /* rows in the surfels of the map */
} Cube;

#define SURFEL_LAYOUT                                                                                                                   \
    LAYOUT_STRUCT(Surfel), LAYOUT_FIELD(Surfel, xyz), LAYOUT_FIELD(Surfel, normal), LAYOUT_FIELD(Surfel, thickness_m),                  \
        LAYOUT_FIELD(Surfel, points), LAYOUT_STRUCT(PackedSurfel), LAYOUT_FIELD(PackedSurfel, xyz), LAYOUT_FIELD(PackedSurfel, normal), \
        LAYOUT_FIELD(PackedSurfel, thickness), LAYOUT_FIELD(PackedSurfel, points), LAYOUT_STRUCT(Cube), LAYOUT_FIELD(Cube, corner),     \
        LAYOUT_FIELD(Cube, first), LAYOUT_FIELD(Cube, count)

/* Unit vector of an octahedral pair. */
static inline void unpack_normal(const int16_t packed[2], float normal[3])
{
    const float x = (float)packed[0], y = (float)packed[1], z = (float)NORMAL_STEPS - fabsf(x) - fabsf(y), fold = z < 0 ? -z : 0.0f;
    const float ux = x + (x < 0 ? fold : -fold), uy = y + (y < 0 ? fold : -fold);
    const float scale = 1.0f / sqrtf(ux * ux + uy * uy + z * z);
    normal[0] = ux * scale, normal[1] = uy * scale, normal[2] = z * scale;
}

static inline float unpack_thickness(uint8_t code)
{
    return THICKNESS_M * (float)(code * code);
}

#endif
