/* One surfel of the map, as the surfel arrays hold it (SURFEL in kernel.py): metres in the surfels' frame, unit normal. */
#ifndef STREETFIX_SURFEL_H
#define STREETFIX_SURFEL_H
#include <stdint.h>

#include "../layout.h"

typedef struct {
    float xyz[3], normal[3], thickness_m;
    uint32_t points;
} Surfel;

#define SURFEL_LAYOUT                                                                                                  \
    LAYOUT_STRUCT(Surfel), LAYOUT_FIELD(Surfel, xyz), LAYOUT_FIELD(Surfel, normal), LAYOUT_FIELD(Surfel, thickness_m), \
        LAYOUT_FIELD(Surfel, points)

#endif
