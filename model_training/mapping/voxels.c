/* Sums the points of a scan by voxel, and computes the normal and the thickness of each voxel of a map from its moments and those of its
 * 26 neighbours; see voxel_map.py.
 *
 * Speed: a quarter and a sixth of the time of NumPy (decision 0166). Plain C without global state. Python checks sizes and pointers. */
#include <math.h>
#include <stdint.h>

#include "../../service/layout.h"

/* Moments of a voxel: count, x, y, z, xx, xy, xz, yy, yz, zz, sum of brightness, number of points that have one. SPAN: cells along an axis.
 * ARGUMENTS, SUM_ARGUMENTS: of streetfix_surfels and streetfix_sums. */
enum { MOMENTS = 12, SPAN = 1 << 20, COLUMNS = 9, ARGUMENTS = 9, SUM_ARGUMENTS = 10, DIGITS = 256 };

/* Compared with Python's constants when the library is loaded. */
const LayoutEntry streetfix_layout[] = {
    LAYOUT_CONSTANT(MOMENTS), LAYOUT_CONSTANT(SPAN), LAYOUT_CONSTANT(ARGUMENTS), LAYOUT_CONSTANT(SUM_ARGUMENTS), LAYOUT_END,
};

/* Sorts points by key and keeps the order of equal keys (radix sort, byte by byte). Bytes that all keys share cost one look. Returns the
 * sorted numbers of the points: order or other. */
static int32_t *sorted(const int64_t *keys, int64_t count, int32_t *order, int32_t *other)
{
    for (int64_t i = 0; i < count; i++) order[i] = (int32_t)i;
    for (int shift = 0; shift < 64; shift += 8) {
        int64_t start[DIGITS] = {0}, before = 0;
        for (int64_t i = 0; i < count; i++) start[(keys[i] >> shift) & (DIGITS - 1)]++;
        if (count == 0 || start[(keys[0] >> shift) & (DIGITS - 1)] == count) continue;
        for (int digit = 0; digit < DIGITS; digit++) {
            const int64_t here = start[digit];
            start[digit] = before;
            before += here;
        }
        for (int64_t i = 0; i < count; i++) other[start[(keys[order[i]] >> shift) & (DIGITS - 1)]++] = order[i];
        int32_t *swapped = order;
        order = other;
        other = swapped;
    }
    return order;
}

/* points: map frame, m (count, 3). intensity: of their returns (count); NULL: unknown. origin: corner of a cell, m (3). farthest: largest
 * distance of a cell from the origin, cells. key_of: memory for the keys of the points (count). numbers: memory for their order
 * (2, count). Writes the keys of the voxels, ascending, to keys, and their moments to moments (count, MOMENTS). Returns the number of voxels;
 * -1 if a point is too far away or not finite. */
int64_t streetfix_sums(const double *points, const float *intensity, int64_t count, const double *origin, double voxel_m, int64_t farthest,
                       int64_t *key_of, int32_t *numbers, int64_t *keys, float *moments)
{
    const double most = (double)farthest;
    for (int64_t i = 0; i < count; i++) {
        int64_t key = 0;
        for (int k = 0; k < 3; k++) {
            const double cell = floor((points[3 * i + k] - origin[k]) / voxel_m);
            if (!(fabs(cell) <= most)) return -1;
            key = key * SPAN + (int64_t)cell + SPAN / 2;
        }
        key_of[i] = key;
    }
    const int32_t *order = sorted(key_of, count, numbers, numbers + count);
    int64_t found = 0;
    for (int64_t i = 0; i < count;) {
        const int64_t key = key_of[order[i]];
        double middle[3], sum[MOMENTS] = {0};
        for (int k = 0; k < 3; k++) {
            const int64_t cell = (k == 0 ? key / ((int64_t)SPAN * SPAN) : k == 1 ? key / SPAN % SPAN : key % SPAN) - SPAN / 2;
            middle[k] = ((double)cell + 0.5) * voxel_m;
        }
        for (; i < count && key_of[order[i]] == key; i++) {
            const double *p = points + 3 * (int64_t)order[i];
            const double x = (p[0] - origin[0]) - middle[0], y = (p[1] - origin[1]) - middle[1], z = (p[2] - origin[2]) - middle[2];
            const double of_point[10] = {1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z};
            for (int k = 0; k < 10; k++) sum[k] += of_point[k];
            if (intensity) {
                sum[10] += intensity[order[i]];
                sum[11] += 1;
            }
        }
        keys[found] = key;
        for (int k = 0; k < MOMENTS; k++) moments[MOMENTS * found + k] = (float)sum[k];
        found++;
    }
    return found;
}

/* Number of keys that are less than ``key``. */
static int64_t less_than(const int64_t *keys, int64_t count, int64_t key)
{
    int64_t low = 0, high = count;
    while (low < high) {
        const int64_t middle = low + (high - low) / 2;
        if (keys[middle] < key)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* Adds the moments of a voxel, displaced by (dx, dy, dz) metres, with a weight. */
static void add_displaced(double *total, const float *m, double weight, double dx, double dy, double dz)
{
    const double n = weight * m[0], x = weight * m[1], y = weight * m[2], z = weight * m[3];
    total[0] += n;
    total[1] += x + n * dx;
    total[2] += y + n * dy;
    total[3] += z + n * dz;
    total[4] += weight * m[4] + 2 * dx * x + n * dx * dx;
    total[5] += weight * m[5] + dx * y + dy * x + n * dx * dy;
    total[6] += weight * m[6] + dx * z + dz * x + n * dx * dz;
    total[7] += weight * m[7] + 2 * dy * y + n * dy * dy;
    total[8] += weight * m[8] + dy * z + dz * y + n * dy * dz;
    total[9] += weight * m[9] + 2 * dz * z + n * dz * dz;
}

/* One rotation of Jacobi's method: makes a[p][q] zero. v collects the axes as columns. */
static void rotate(double a[3][3], double v[3][3], int p, int q)
{
    if (a[p][q] == 0) return;
    const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
    const double t = (theta < 0 ? -1 : 1) / (fabs(theta) + sqrt(theta * theta + 1));
    const double c = 1 / sqrt(t * t + 1), s = t * c;
    const int r = 3 - p - q;
    const double pq = a[p][q], rp = a[r][p], rq = a[r][q];
    a[p][p] -= t * pq;
    a[q][q] += t * pq;
    a[p][q] = a[q][p] = 0;
    a[r][p] = a[p][r] = c * rp - s * rq;
    a[r][q] = a[q][r] = s * rp + c * rq;
    for (int k = 0; k < 3; k++) {
        const double kp = v[k][p], kq = v[k][q];
        v[k][p] = c * kp - s * kq;
        v[k][q] = s * kp + c * kq;
    }
}

/* Axis of least variance, and this variance (Golub and Van Loan, Matrix Computations, 8.5). Five sweeps leave nothing to rotate. */
static double least_axis(const double *total, double *axis)
{
    const double n = total[0], x = total[1] / n, y = total[2] / n, z = total[3] / n;
    const double xy = total[5] / n - x * y, xz = total[6] / n - x * z, yz = total[8] / n - y * z;
    double a[3][3] = {
        {total[4] / n - x * x, xy, xz},
        {xy, total[7] / n - y * y, yz},
        {xz, yz, total[9] / n - z * z},
    };
    double v[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    for (int sweep = 0; sweep < 5; sweep++) {
        rotate(a, v, 0, 1);
        rotate(a, v, 0, 2);
        rotate(a, v, 1, 2);
    }
    int least = 0;
    for (int k = 1; k < 3; k++) least = a[k][k] < a[least][least] ? k : least;
    for (int k = 0; k < 3; k++) axis[k] = v[k][least];
    return a[least][least];
}

/* Keys ascend, so the neighbours of successive voxels do too: nine positions that only move forward replace 27 searches.
 *
 * keys: of the voxels, ascending (count). moments: (count, MOMENTS). weights: of a neighbour, by the number of axes along which it is
 * displaced (4). fewest: least number of points in a voxel and its neighbours together. Results, one for each voxel: around, this
 * number; normals (count, 3) and thickness_m, not set where around is less than fewest. */
void streetfix_surfels(const int64_t *keys, const float *moments, int64_t count, double voxel_m, const double *weights, double fewest,
                       double *around, float *normals, float *thickness_m)
{
    int64_t at[COLUMNS], away[COLUMNS];
    for (int c = 0; c < COLUMNS; c++) {
        away[c] = ((int64_t)(c / 3 - 1) * SPAN + (c % 3 - 1)) * SPAN;
        at[c] = count ? less_than(keys, count, keys[0] + away[c] - 1) : 0;
    }
    for (int64_t i = 0; i < count; i++) {
        double total[10] = {0}, points = 0;
        for (int c = 0; c < COLUMNS; c++) {
            const int64_t lowest = keys[i] + away[c] - 1;
            while (at[c] < count && keys[at[c]] < lowest) at[c]++;
            for (int64_t k = at[c]; k < count && keys[k] <= lowest + 2; k++) {
                const int dx = c / 3 - 1, dy = c % 3 - 1, dz = (int)(keys[k] - lowest) - 1;
                const float *m = moments + MOMENTS * k;
                points += m[0];
                add_displaced(total, m, weights[(dx != 0) + (dy != 0) + (dz != 0)], dx * voxel_m, dy * voxel_m, dz * voxel_m);
            }
        }
        around[i] = points;
        if (points < fewest) continue;
        double axis[3];
        const double variance = least_axis(total, axis);
        for (int k = 0; k < 3; k++) normals[3 * i + k] = (float)axis[k];
        thickness_m[i] = (float)sqrt(variance > 0 ? variance : 0);
    }
}
