/* Finds the voxels that a scan sees through; see passes.py, which states the conditions.
 *
 * Speed: 0.35 of the time of NumPy (decision 0166). Plain C without global state. Python checks sizes and pointers. */
#include <math.h>
#include <stdint.h>

#include "../../service/layout.h"

/* Size of the range image: elevations from -45 to 45 degrees, all azimuths. MOMENTS, SPAN: as in voxels.c. ARGUMENTS: of
 * streetfix_looked_through. */
enum { ROWS = 180, COLUMNS = 720, MOMENTS = 12, SPAN = 1 << 20, ARGUMENTS = 14 };

#define DEGREES 57.29577951308232
#define CELL_DEG 0.5

/* Compared with Python's constants when the library is loaded. */
const LayoutEntry streetfix_layout[] = {
    LAYOUT_CONSTANT(ROWS), LAYOUT_CONSTANT(COLUMNS),   LAYOUT_CONSTANT(MOMENTS),
    LAYOUT_CONSTANT(SPAN), LAYOUT_CONSTANT(ARGUMENTS), LAYOUT_END,
};

/* Cell of a direction; -1 beyond the rows. */
static int64_t cell_of(double x, double y, double z, double range)
{
    const double row = floor((asin(z / range) * DEGREES + 45.0) / CELL_DEG);
    if (!(row >= 0 && row < ROWS)) return -1;
    const int64_t column = (int64_t)floor((atan2(y, x) * DEGREES + 180.0) / CELL_DEG) % COLUMNS;
    return (int64_t)row * COLUMNS + column;
}

static double less_of(double one, double other)
{
    return one < other ? one : other;
}

/* The least range of each cell and the eight around it. Azimuths go round, elevations end. */
static void least_around(const double *ranges, double *least)
{
    for (int64_t row = 0; row < ROWS; row++) {
        const double *here = ranges + row * COLUMNS, *above = row > 0 ? here - COLUMNS : here;
        const double *below = row < ROWS - 1 ? here + COLUMNS : here;
        double *found = least + row * COLUMNS;
        for (int64_t c = 0; c < COLUMNS; c++) found[c] = less_of(less_of(above[c], here[c]), below[c]);
        const double first = found[0];
        double left = found[COLUMNS - 1];
        for (int64_t c = 0; c < COLUMNS; c++) {
            const double own = found[c], right = c < COLUMNS - 1 ? found[c + 1] : first;
            found[c] = less_of(less_of(left, own), right);
            left = own;
        }
    }
}

/* Mean of a voxel's points, map frame, m. */
static void mean_of(int64_t key, const float *moments, const double *origin, double voxel_m, double *mean)
{
    const int64_t cells[3] = {key / ((int64_t)SPAN * SPAN), key / SPAN % SPAN, key % SPAN};
    for (int k = 0; k < 3; k++) {
        const double centre = origin[k] + ((double)(cells[k] - SPAN / 2) + 0.5) * voxel_m;
        mean[k] = centre + moments[1 + k] / (double)moments[0];
    }
}

/* points: of the scan, LiDAR frame, m (count, 3). keys, moments, origin, and the edge of a voxel, which is also off_plane_m: of the voxel
 * map (n; n, MOMENTS; 3). normals: of its voxels, map frame (n, 3). candidates: rows of the voxels to test (number). T: T_lidar_map, row by
 * row (3, 4). nearest_m: nearer points lie on the vehicle. reach_m: largest range of a voxel. behind_m: least distance between the voxel
 * and the end of a ray behind it; a hundredth of the range is added. off_plane_m: the end of the ray lies farther than this off the
 * voxel's plane. point_at, least, ranges: memory for the range image (ROWS x COLUMNS each). Writes the rows of the voxels that are seen
 * through to seen (number); returns how many. */
int64_t streetfix_looked_through(const double *points, int64_t count, const int64_t *keys, const float *moments, const double *origin,
                                 const float *normals, const int32_t *candidates, int64_t number, const double *T, const double *limits,
                                 int32_t *point_at, double *least, double *ranges, int32_t *seen)
{
    const double nearest_m = limits[0], reach_m = limits[1], behind_m = limits[2], off_plane_m = limits[3];
    for (int64_t c = 0; c < ROWS * COLUMNS; c++) {
        point_at[c] = -1;
        ranges[c] = INFINITY;
    }
    /* The nearest point of each cell; of equally near ones the last. */
    for (int64_t i = 0; i < count; i++) {
        const double *p = points + 3 * i;
        const double range = sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
        if (!(range > nearest_m)) continue;
        const int64_t cell = cell_of(p[0], p[1], p[2], range);
        if (cell >= 0 && range <= ranges[cell]) {
            ranges[cell] = range;
            point_at[cell] = (int32_t)i;
        }
    }
    least_around(ranges, least);
    int64_t found = 0;
    for (int64_t i = 0; i < number; i++) {
        const int64_t row = candidates[i];
        double m[3];
        mean_of(keys[row], moments + MOMENTS * row, origin, off_plane_m, m);
        const double x = T[0] * m[0] + T[1] * m[1] + T[2] * m[2] + T[3], y = T[4] * m[0] + T[5] * m[1] + T[6] * m[2] + T[7];
        const double z = T[8] * m[0] + T[9] * m[1] + T[10] * m[2] + T[11], away = sqrt(x * x + y * y + z * z);
        if (!(away > nearest_m && away <= reach_m)) continue;
        const int64_t cell = cell_of(x, y, z, away);
        if (cell < 0 || point_at[cell] < 0 || !(least[cell] >= away * 1.01 + behind_m)) continue;
        const double *end = points + 3 * point_at[cell];
        const float *n = normals + 3 * row;
        const double off = (end[0] - x) * (T[0] * n[0] + T[1] * n[1] + T[2] * n[2]) +
                           (end[1] - y) * (T[4] * n[0] + T[5] * n[1] + T[6] * n[2]) +
                           (end[2] - z) * (T[8] * n[0] + T[9] * n[1] + T[10] * n[2]);
        if (fabs(off) > off_plane_m) seen[found++] = (int32_t)row;
    }
    return found;
}
