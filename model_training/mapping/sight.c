/* Finds the voxels that a scan sees through; see passes.py, which states the conditions.
 *
 * Speed: decisions 0166 and 0197. Plain C without global state. Python checks sizes and pointers. */
#include <math.h>
#include <stdint.h>

#include "../../service/layout.h"
#include "../../service/registration/wide.h"

/* Size of the range image: elevations from -45 to 45 degrees, all azimuths. MOMENTS, SPAN: as in voxels.c. ARGUMENTS: of
 * streetfix_looked_through. */
enum { ROWS = 180, COLUMNS = 720, MOMENTS = 12, AXIS_BITS = 20, SPAN = 1 << AXIS_BITS, ARGUMENTS = 14 };

#define DEGREES 57.29577951308232
#define CELL_DEG 0.5

/* Compared with Python's constants when the library is loaded. */
const LayoutEntry streetfix_layout[] = {
    LAYOUT_CONSTANT(ROWS), LAYOUT_CONSTANT(COLUMNS),   LAYOUT_CONSTANT(MOMENTS),
    LAYOUT_CONSTANT(SPAN), LAYOUT_CONSTANT(ARGUMENTS), LAYOUT_END,
};

/* A direction this near to the limit of a cell is computed with the functions of the C library, whose rounding decides. Their error, and
 * that of the limits below, is more than a hundred times smaller. */
#define NEAR_LIMIT 1e-12
/* Buckets of the sine of an elevation, and of the tangent of an azimuth up to 45 degrees. Each has at most one limit. */
enum { SINES = 1024, TANGENTS = 256, EIGHTH = COLUMNS / 8 };

/* The limits of the cells: sines of elevations from -45 to 45 degrees, tangents of azimuths from 0 to 45 degrees. For each bucket the last
 * limit at or before its start. */
typedef struct {
    double sines[ROWS + 1], tangents[EIGHTH + 1], buckets_per_sine;
    uint8_t row_at[SINES], column_at[TANGENTS];
} Limits;

static inline int64_t less_number(int64_t one, int64_t other)
{
    return one < other ? one : other;
}

static void sort_limits(const double *limits, int64_t count, uint8_t *at, int64_t buckets)
{
    for (int64_t bucket = 0, limit = 0; bucket < buckets; bucket++) {
        const double start = limits[0] + (limits[count] - limits[0]) * (double)bucket / (double)buckets;
        while (limit + 1 < count && limits[limit + 1] <= start) limit++;
        at[bucket] = (uint8_t)limit;
    }
}

static void set_limits(Limits *limits)
{
    for (int k = 0; k <= ROWS; k++) limits->sines[k] = sin((k * CELL_DEG - 45.0) / DEGREES);
    for (int k = 0; k <= EIGHTH; k++) limits->tangents[k] = tan(k * CELL_DEG / DEGREES);
    limits->buckets_per_sine = SINES / (limits->sines[ROWS] - limits->sines[0]);
    sort_limits(limits->sines, ROWS, limits->row_at, SINES);
    sort_limits(limits->tangents, EIGHTH, limits->column_at, TANGENTS);
}

/* Cell of a direction; -1 beyond the rows. */
static int64_t exact_cell_of(double x, double y, double sine)
{
    const double row = floor((asin(sine) * DEGREES + 45.0) / CELL_DEG);
    if (!(row >= 0 && row < ROWS)) return -1;
    const int64_t column = (int64_t)floor((atan2(y, x) * DEGREES + 180.0) / CELL_DEG) % COLUMNS;
    return (int64_t)row * COLUMNS + column;
}

/* Directions that are computed together, so that none waits for the divisions and the memory of another. */
enum { TOGETHER = 64 };

/* Positions in the LiDAR frame (m), their ranges (m) and their cells, -1 beyond the rows. */
typedef struct {
    double x[TOGETHER], y[TOGETHER], z[TOGETHER], range[TOGETHER], sine[TOGETHER], tangent[TOGETHER];
    int64_t cell[TOGETHER];
} Directions;

/* Sets the ranges, and the sine of the elevation and the tangent of the azimuth from the nearest axis. */
static inline void set_angles(Directions *d, int64_t count)
{
    for (int64_t i = 0; i < count; i++) {
        const double x = d->x[i], y = d->y[i], z = d->z[i], to_x = fabs(x), to_y = fabs(y), range = sqrt(x * x + y * y + z * z);
        d->range[i] = range;
        d->sine[i] = z / range;
        d->tangent[i] = (to_x >= to_y ? to_y : to_x) / (to_x >= to_y ? to_x : to_y);
    }
}

/* The same cell as exact_cell_of, by comparison with the limits. */
static inline int64_t cell_of(const Limits *limits, double x, double y, double sine, double tangent)
{
    /* Column of the nearest axis, and whether columns count down from it. Column 0 begins at -x; they go by -y, x and y. The index has a bit
     * each for: the axis is x, x is negative, y is negative. */
    static const int16_t axis_at[8] = {540, 180, 540, 180, 360, 360, 720, 0}, counts_down[8] = {-1, 0, 0, -1, 0, -1, -1, 0};
    const double *sines = limits->sines, *tangents = limits->tangents;
    if (!(sine > sines[0] && sine < sines[ROWS] && tangent >= 0 && tangent <= 1)) return exact_cell_of(x, y, sine);
    int64_t row = limits->row_at[less_number((int64_t)((sine - sines[0]) * limits->buckets_per_sine), SINES - 1)];
    row += sine >= sines[row + 1];
    int64_t step = limits->column_at[less_number((int64_t)(tangent * TANGENTS), TANGENTS - 1)];
    step += tangent >= tangents[step + 1];
    if (!(row < ROWS && step < EIGHTH && sine - sines[row] > NEAR_LIMIT && sines[row + 1] - sine > NEAR_LIMIT &&
          tangent - tangents[step] > NEAR_LIMIT && tangents[step + 1] - tangent > NEAR_LIMIT))
        return exact_cell_of(x, y, sine);
    const int octant = 4 * (fabs(x) >= fabs(y)) + 2 * (x < 0) + (y < 0);
    return row * COLUMNS + axis_at[octant] + (step ^ counts_down[octant]);
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

/* Centre of a voxel, map frame, m. */
static inline void centre_of(int64_t key, const double *origin, double voxel_m, double *centre)
{
    const int64_t cells[3] = {key >> 2 * AXIS_BITS, key >> AXIS_BITS & (SPAN - 1), key & (SPAN - 1)};
    for (int k = 0; k < 3; k++) centre[k] = origin[k] + ((double)(cells[k] - SPAN / 2) + 0.5) * voxel_m;
}

/* points: of the scan, LiDAR frame, m (count, 3). keys, moments, origin, and the edge of a voxel, which is also off_plane_m: of the voxel
 * map (n; n, MOMENTS; 3). normals: of its voxels, map frame (n, 3). candidates: rows of the voxels to test (number). T: T_lidar_map, row by
 * row (3, 4). nearest_m: nearer points lie on the vehicle. reach_m: largest range of a voxel. behind_m: least distance between the voxel
 * and the end of a ray behind it; a hundredth of the range is added. off_plane_m: the end of the ray lies farther than this off the
 * voxel's plane. point_at, least, ranges: memory for the range image (ROWS x COLUMNS each). Writes the rows of the voxels that are seen
 * through to seen (number); returns how many. */
WIDE int64_t streetfix_looked_through(const double *points, int64_t count, const int64_t *keys, const float *moments, const double *origin,
                                      const float *normals, const int32_t *candidates, int64_t number, const double *T, const double *given,
                                      int32_t *point_at, double *least, double *ranges, int32_t *seen)
{
    const double nearest_m = given[0], reach_m = given[1], behind_m = given[2], off_plane_m = given[3];
    Limits limits;
    set_limits(&limits);
    for (int64_t c = 0; c < ROWS * COLUMNS; c++) ranges[c] = INFINITY; /* no point */
    Directions d;
    /* The nearest point of each cell; of equally near ones the last. */
    for (int64_t first = 0; first < count; first += TOGETHER) {
        const int64_t some = count - first < TOGETHER ? count - first : TOGETHER;
        for (int64_t i = 0; i < some; i++) {
            const double *p = points + 3 * (first + i);
            d.x[i] = p[0], d.y[i] = p[1], d.z[i] = p[2];
        }
        set_angles(&d, some);
        for (int64_t i = 0; i < some; i++) {
            if (!(d.range[i] > nearest_m)) continue;
            const int64_t cell = cell_of(&limits, d.x[i], d.y[i], d.sine[i], d.tangent[i]);
            if (cell >= 0 && d.range[i] <= ranges[cell]) {
                ranges[cell] = d.range[i];
                point_at[cell] = (int32_t)(first + i);
            }
        }
    }
    least_around(ranges, least);
    double lidar[3];
    for (int k = 0; k < 3; k++) lidar[k] = -(T[k] * T[3] + T[4 + k] * T[7] + T[8 + k] * T[11]);
    const double far_m = reach_m + 2 * off_plane_m; /* the mean of a voxel is less than two edges from its centre */
    int64_t found = 0;
    for (int64_t next = 0; next < number;) {
        int32_t rows[TOGETHER];
        int64_t some = 0;
        for (; next < number && some < TOGETHER; next++) {
            double centre[3], off2 = 0;
            centre_of(keys[candidates[next]], origin, off_plane_m, centre);
            for (int k = 0; k < 3; k++) off2 += (centre[k] - lidar[k]) * (centre[k] - lidar[k]);
            rows[some] = candidates[next];
            __builtin_prefetch(moments + MOMENTS * (int64_t)rows[some]);
            some += off2 <= far_m * far_m;
        }
        for (int64_t i = 0; i < some; i++) {
            double m[3];
            const float *moment = moments + MOMENTS * (int64_t)rows[i];
            centre_of(keys[rows[i]], origin, off_plane_m, m);
            for (int k = 0; k < 3; k++) m[k] = m[k] + moment[1 + k] / (double)moment[0];
            d.x[i] = T[0] * m[0] + T[1] * m[1] + T[2] * m[2] + T[3];
            d.y[i] = T[4] * m[0] + T[5] * m[1] + T[6] * m[2] + T[7];
            d.z[i] = T[8] * m[0] + T[9] * m[1] + T[10] * m[2] + T[11];
        }
        set_angles(&d, some);
        for (int64_t i = 0; i < some; i++) {
            d.cell[i] = cell_of(&limits, d.x[i], d.y[i], d.sine[i], d.tangent[i]);
            __builtin_prefetch(least + (d.cell[i] < 0 ? 0 : d.cell[i]));
        }
        for (int64_t i = 0; i < some; i++) {
            const int64_t cell = d.cell[i];
            if (cell < 0 || !(least[cell] >= d.range[i] * 1.01 + behind_m)) continue;
            if (ranges[cell] == INFINITY || !(d.range[i] > nearest_m && d.range[i] <= reach_m)) continue;
            const double *end = points + 3 * point_at[cell];
            const float *n = normals + 3 * (int64_t)rows[i];
            const double off = (end[0] - d.x[i]) * (T[0] * n[0] + T[1] * n[1] + T[2] * n[2]) +
                               (end[1] - d.y[i]) * (T[4] * n[0] + T[5] * n[1] + T[6] * n[2]) +
                               (end[2] - d.z[i]) * (T[8] * n[0] + T[9] * n[1] + T[10] * n[2]);
            if (fabs(off) > off_plane_m) seen[found++] = rows[i];
        }
    }
    return found;
}
