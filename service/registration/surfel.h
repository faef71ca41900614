/* A surface element of the map, as surfel arrays hold it (SURFEL in kernel.py). */
#ifndef STREETFIX_SURFEL_H
#define STREETFIX_SURFEL_H
#include <stdint.h>

typedef struct {
    float x, y, z, nx, ny, nz, thickness;
    uint32_t points;
} Surfel;

#endif
