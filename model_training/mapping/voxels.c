/* Sums points by voxel, finds the voxels of points, adds such sums to a map, and computes the normal and the thickness of each voxel of a
 * map from its moments and those of its 26 neighbours; see voxel_map.py.
 *
 * Speed: decisions 0166 and 0197. Plain C without global state. Python checks sizes and pointers. */
#include <math.h>
#include <stdint.h>

#include "../../service/layout.h"
#include "../../service/registration/wide.h"

/* Moments of a voxel: count, x, y, z, xx, xy, xz, yy, yz, zz, sum of brightness, number of points that have one. SPAN: cells along an axis.
 * The numbers of arguments: of streetfix_surfels, streetfix_sums, streetfix_rows, streetfix_summed and streetfix_absorb. */
enum {
    MOMENTS = 12,
    SPAN = 1 << 20,
    COLUMNS = 9,
    SURFELS_ARGUMENTS = 9,
    SUMS_ARGUMENTS = 14,
    ROWS_ARGUMENTS = 12,
    SUMMED_ARGUMENTS = 6,
    ABSORB_ARGUMENTS = 7,
    DIGIT_BITS = 11,
    DIGITS = 1 << DIGIT_BITS
};

/* Compared with Python's constants when the library is loaded. */
const LayoutEntry streetfix_layout[] = {
    LAYOUT_CONSTANT(MOMENTS),           LAYOUT_CONSTANT(SPAN),
    LAYOUT_CONSTANT(SURFELS_ARGUMENTS), LAYOUT_CONSTANT(SUMS_ARGUMENTS),
    LAYOUT_CONSTANT(ROWS_ARGUMENTS),    LAYOUT_CONSTANT(SUMMED_ARGUMENTS),
    LAYOUT_CONSTANT(ABSORB_ARGUMENTS),  LAYOUT_END,
};

/* Sorts numbers by key and keeps the order of equal keys (radix sort, a digit at a time). Digits begin at a bit in which the keys differ,
 * so a scan takes about one digit for each axis. Returns the sorted numbers: order or other. */
static int32_t *sorted(const int64_t *keys, int64_t count, int32_t *order, int32_t *other)
{
    int64_t differing = 0;
    for (int64_t i = 0; i < count; i++) {
        order[i] = (int32_t)i;
        differing |= keys[i] ^ keys[0];
    }
    for (int shift = 0; shift < 63;) {
        if (!(differing >> shift & 1)) {
            shift++;
            continue;
        }
        int32_t start[DIGITS] = {0}, before = 0;
        for (int64_t i = 0; i < count; i++) start[keys[i] >> shift & (DIGITS - 1)]++;
        for (int digit = 0; digit < DIGITS; digit++) {
            const int32_t here = start[digit];
            start[digit] = before;
            before += here;
        }
        for (int64_t i = 0; i < count; i++) other[start[keys[order[i]] >> shift & (DIGITS - 1)]++] = order[i];
        int32_t *swapped = order;
        order = other;
        other = swapped;
        shift += DIGIT_BITS;
    }
    return order;
}

/* A lattice of cells: its corner (3) and the edge of a cell, m, and the largest distance of a cell from the corner, cells. */
typedef struct {
    const double *origin;
    double edge_m, farthest;
} Lattice;

/* Cells of a point along the three axes. Returns 0 if the point is too far away or not finite. */
static inline int cells_of(const Lattice *lattice, const double *point, double *cells)
{
    int inside = 1;
    for (int k = 0; k < 3; k++) {
        cells[k] = floor((point[k] - lattice->origin[k]) / lattice->edge_m);
        inside &= fabs(cells[k]) <= lattice->farthest;
    }
    return inside;
}

static inline int64_t key_of(const double *cells)
{
    const int64_t x = (int64_t)cells[0] + SPAN / 2, y = (int64_t)cells[1] + SPAN / 2, z = (int64_t)cells[2] + SPAN / 2;
    return (x * SPAN + y) * SPAN + z;
}

/* The distinct keys of points, numbered in the order of their first points. */
typedef struct {
    int64_t *keys;      /* by number */
    int32_t *slots;     /* hash table with linear probing: a number, -1 for none; more slots than points */
    int64_t slot_bits;  /* binary logarithm of the number of slots */
    int64_t count;      /* of the keys so far */
} Distinct;

static inline void forget(Distinct *found)
{
    found->count = 0;
    for (int64_t i = 0; i < (int64_t)1 << found->slot_bits; i++) found->slots[i] = -1;
}

/* Number of a key, which is new if it equals the number of keys before the call (Fibonacci hashing: Knuth, The Art of Computer
 * Programming 3, section 6.4). */
static inline int32_t number_of(Distinct *found, int64_t key)
{
    const int64_t last = ((int64_t)1 << found->slot_bits) - 1;
    int64_t slot = (int64_t)(((uint64_t)key * 0x9E3779B97F4A7C15u) >> (64 - found->slot_bits));
    for (; found->slots[slot] >= 0; slot = (slot + 1) & last)
        if (found->keys[found->slots[slot]] == key) return found->slots[slot];
    found->slots[slot] = (int32_t)found->count;
    found->keys[found->count] = key;
    return (int32_t)found->count++;
}

/* points: map frame, m (count, 3). intensity: of their returns (count); NULL: unknown. origin: corner of a cell, m (3). farthest: largest
 * distance of a cell from the origin, cells. Memory: key_of_number (count), slots (2 to the power of slot_bits, more than count), numbers
 * (2, count), sums (count, MOMENTS). Writes the keys of the voxels, ascending, to keys, their moments to moments (count, MOMENTS), and the row
 * of the voxel of each point to row_of (count) unless it is NULL. Returns the number of voxels; -1 if a point is too far away or not finite. */
WIDE int64_t streetfix_sums(const double *points, const float *intensity, int64_t count, const double *origin, double voxel_m,
                            int64_t farthest, int64_t *key_of_number, int32_t *slots, int64_t slot_bits, int32_t *numbers, double *sums,
                            int64_t *keys, float *moments, int32_t *row_of)
{
    const Lattice lattice = {origin, voxel_m, (double)farthest};
    Distinct found = {key_of_number, slots, slot_bits, 0};
    forget(&found);
    int64_t before = -1;
    int32_t number = 0;
    for (int64_t i = 0; i < count; i++) {
        const double *p = points + 3 * i;
        double cells[3];
        if (!cells_of(&lattice, p, cells)) return -1;
        const int64_t key = key_of(cells), known = found.count;
        if (key != before) number = number_of(&found, key); /* many points lie in the voxel of the point before */
        before = key;
        if (row_of) row_of[i] = number;
        double *sum = sums + MOMENTS * (int64_t)number;
        if (number == known)
            for (int k = 0; k < MOMENTS; k++) sum[k] = 0;
        const double x = (p[0] - origin[0]) - (cells[0] + 0.5) * voxel_m, y = (p[1] - origin[1]) - (cells[1] + 0.5) * voxel_m;
        const double z = (p[2] - origin[2]) - (cells[2] + 0.5) * voxel_m;
        const double of_point[10] = {1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z};
        for (int k = 0; k < 10; k++) sum[k] += of_point[k];
        if (intensity) {
            sum[10] += intensity[i];
            sum[11] += 1;
        }
    }
    const int32_t *order = sorted(key_of_number, found.count, numbers, numbers + count);
    for (int64_t i = 0; i < found.count; i++) {
        const int64_t of = order[i];
        keys[i] = key_of_number[of];
        for (int k = 0; k < MOMENTS; k++) moments[MOMENTS * i + k] = (float)sums[MOMENTS * of + k];
    }
    if (row_of) {
        int32_t *const row_of_number = slots; /* the table is of no use any more */
        for (int64_t i = 0; i < found.count; i++) row_of_number[order[i]] = (int32_t)i;
        for (int64_t i = 0; i < count; i++) row_of[i] = row_of_number[row_of[i]];
    }
    return found.count;
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

/* First position from ``at`` on whose key is not less than ``key``. Near positions take fewer steps. */
static inline int64_t first_from(const int64_t *keys, int64_t count, int64_t at, int64_t key)
{
    if (at >= count || keys[at] >= key) return at;
    int64_t step = 1;
    for (; at + step < count && keys[at + step] < key; step *= 2) at += step;
    const int64_t end = at + step < count ? at + step : count;
    return at + 1 + less_than(keys + at + 1, end - at - 1, key);
}

/* points, origin, voxel_m, farthest and memory: as of streetfix_sums. keys: of a map's voxels, ascending (voxels). Writes the rows of those
 * that hold a point, ascending, to rows (count). Returns their number; -1 if a point is too far away or not finite. */
WIDE int64_t streetfix_rows(const double *points, int64_t count, const double *origin, double voxel_m, int64_t farthest,
                            int64_t *key_of_number, int32_t *slots, int64_t slot_bits, int32_t *numbers, const int64_t *keys,
                            int64_t voxels, int32_t *rows)
{
    const Lattice lattice = {origin, voxel_m, (double)farthest};
    Distinct found = {key_of_number, slots, slot_bits, 0};
    forget(&found);
    int64_t before = -1;
    for (int64_t i = 0; i < count; i++) {
        double cells[3];
        if (!cells_of(&lattice, points + 3 * i, cells)) return -1;
        const int64_t key = key_of(cells);
        if (key != before) number_of(&found, key);
        before = key;
    }
    const int32_t *order = sorted(key_of_number, found.count, numbers, numbers + count);
    int64_t at = 0, known = 0;
    for (int64_t i = 0; i < found.count; i++) {
        const int64_t key = key_of_number[order[i]];
        at = first_from(keys, voxels, at, key);
        if (at < voxels && keys[at] == key) rows[known++] = (int32_t)at;
    }
    return known;
}

/* Adds up the moments of some rows, in the order and with the rounding of NumPy's sums: blocks of up to 128 rows with eight partial sums. */
static void add_up(const float *moments, const int64_t *rows, int64_t count, float *total)
{
    if (count < 8) {
        for (int k = 0; k < MOMENTS; k++) total[k] = -0.0f;
        for (int64_t i = 0; i < count; i++)
            for (int k = 0; k < MOMENTS; k++) total[k] += moments[MOMENTS * rows[i] + k];
    } else if (count <= 128) {
        float part[8][MOMENTS];
        for (int j = 0; j < 8; j++)
            for (int k = 0; k < MOMENTS; k++) part[j][k] = moments[MOMENTS * rows[j] + k];
        int64_t i = 8;
        for (; i < count - count % 8; i += 8)
            for (int j = 0; j < 8; j++)
                for (int k = 0; k < MOMENTS; k++) part[j][k] += moments[MOMENTS * rows[i + j] + k];
        for (int k = 0; k < MOMENTS; k++)
            total[k] = ((part[0][k] + part[1][k]) + (part[2][k] + part[3][k])) + ((part[4][k] + part[5][k]) + (part[6][k] + part[7][k]));
        for (; i < count; i++)
            for (int k = 0; k < MOMENTS; k++) total[k] += moments[MOMENTS * rows[i] + k];
    } else {
        const int64_t half = count / 2 - count / 2 % 8;
        float other[MOMENTS];
        add_up(moments, rows, half, total);
        add_up(moments, rows + half, count - half, other);
        for (int k = 0; k < MOMENTS; k++) total[k] += other[k];
    }
}

/* Adds up the moments (count, MOMENTS) of rows with equal key. rows: numbers of the rows, sorted by key (count). Writes the keys,
 * ascending, to found_keys and the sums to found_moments. Returns the number of keys. */
int64_t streetfix_summed(const int64_t *keys, const float *moments, const int64_t *rows, int64_t count, int64_t *found_keys,
                         float *found_moments)
{
    int64_t found = 0;
    for (int64_t i = 0; i < count;) {
        const int64_t key = keys[rows[i]];
        int64_t end = i + 1;
        while (end < count && keys[rows[end]] == key) end++;
        float rest[MOMENTS], *sum = found_moments + MOMENTS * found;
        const float *first = moments + MOMENTS * rows[i];
        add_up(moments, rows + i + 1, end - i - 1, rest);
        for (int k = 0; k < MOMENTS; k++) sum[k] = end > i + 1 ? first[k] + rest[k] : first[k];
        found_keys[found++] = key;
        i = end;
    }
    return found;
}

/* Adds sums to the voxels of a map. keys, moments: of the map (count; count, MOMENTS). added_keys, added: the sums (number; number,
 * MOMENTS). Keys ascend. Sums of unknown voxels move to the front of their arrays, and the rows before which they belong are written to
 * ``before`` (number). Returns how many they are. */
int64_t streetfix_absorb(const int64_t *keys, float *moments, int64_t count, int64_t *added_keys, float *added, int64_t number,
                         int64_t *before)
{
    int64_t at = 0, unknown = 0;
    for (int64_t i = 0; i < number; i++) {
        at = first_from(keys, count, at, added_keys[i]);
        if (at < count && keys[at] == added_keys[i]) {
            for (int k = 0; k < MOMENTS; k++) moments[MOMENTS * at + k] += added[MOMENTS * i + k];
        } else {
            added_keys[unknown] = added_keys[i];
            for (int k = 0; k < MOMENTS; k++) added[MOMENTS * unknown + k] = added[MOMENTS * i + k];
            before[unknown++] = at;
        }
    }
    return unknown;
}

/* Adds the moments of a voxel, displaced by (dx, dy, dz) metres, with a weight. */
static inline void add_displaced(double *total, const float *m, double weight, double dx, double dy, double dz)
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

/* Voxels whose axes are computed at once. One rotation waits for divisions and roots; others fill this time. */
#define LANES 32

/* Symmetric 3 x 3 matrices of several voxels, and their axes as columns. */
typedef struct {
    double a[3][3][LANES], v[3][3][LANES]; /* of a, the upper triangle */
} Matrices;

/* One rotation of Jacobi's method: makes a[p][q] zero, p < q. v collects the axes as columns. Where a[p][q] is zero, all stays. */
static inline void rotate(Matrices *m, int p, int q)
{
    const int r = 3 - p - q;
    double *a_pp = m->a[p][p], *a_qq = m->a[q][q], *a_pq = m->a[p][q];
    double *a_rp = m->a[r < p ? r : p][r < p ? p : r], *a_rq = m->a[r < q ? r : q][r < q ? q : r];
    double tangent[LANES], cosine[LANES], sine[LANES];
    for (int l = 0; l < LANES; l++) {
        const double theta = (a_qq[l] - a_pp[l]) / (2 * a_pq[l]);
        tangent[l] = (theta < 0 ? -1 : 1) / (fabs(theta) + sqrt(theta * theta + 1));
        cosine[l] = 1 / sqrt(tangent[l] * tangent[l] + 1);
        sine[l] = tangent[l] * cosine[l];
    }
    for (int k = 0; k < 3; k++)
        for (int l = 0; l < LANES; l++) {
            const double kp = m->v[k][p][l], kq = m->v[k][q][l];
            const double new_p = cosine[l] * kp - sine[l] * kq, new_q = sine[l] * kp + cosine[l] * kq;
            m->v[k][p][l] = a_pq[l] != 0 ? new_p : kp;
            m->v[k][q][l] = a_pq[l] != 0 ? new_q : kq;
        }
    for (int l = 0; l < LANES; l++) {
        const double pp = a_pp[l] - tangent[l] * a_pq[l], qq = a_qq[l] + tangent[l] * a_pq[l];
        const double rp = cosine[l] * a_rp[l] - sine[l] * a_rq[l], rq = sine[l] * a_rp[l] + cosine[l] * a_rq[l];
        a_pp[l] = a_pq[l] != 0 ? pp : a_pp[l];
        a_qq[l] = a_pq[l] != 0 ? qq : a_qq[l];
        a_rp[l] = a_pq[l] != 0 ? rp : a_rp[l];
        a_rq[l] = a_pq[l] != 0 ? rq : a_rq[l];
    }
    for (int l = 0; l < LANES; l++) a_pq[l] = 0;
}

/* Axis of least variance of each voxel, and this variance, from its moments (10, LANES) (Golub and Van Loan, Matrix Computations, 8.5).
 * Five sweeps leave nothing to rotate. */
static inline void least_axes(double total[10][LANES], double axis[3][LANES], double *variance)
{
    Matrices m;
    for (int l = 0; l < LANES; l++) {
        const double n = total[0][l], x = total[1][l] / n, y = total[2][l] / n, z = total[3][l] / n;
        m.a[0][0][l] = total[4][l] / n - x * x, m.a[0][1][l] = total[5][l] / n - x * y, m.a[0][2][l] = total[6][l] / n - x * z;
        m.a[1][1][l] = total[7][l] / n - y * y, m.a[1][2][l] = total[8][l] / n - y * z, m.a[2][2][l] = total[9][l] / n - z * z;
    }
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++)
            for (int l = 0; l < LANES; l++) m.v[i][k][l] = i == k;
    for (int sweep = 0; sweep < 5; sweep++) {
        rotate(&m, 0, 1);
        rotate(&m, 0, 2);
        rotate(&m, 1, 2);
    }
    for (int l = 0; l < LANES; l++) {
        int least = 0;
        for (int k = 1; k < 3; k++) least = m.a[k][k][l] < m.a[least][least][l] ? k : least;
        for (int k = 0; k < 3; k++) axis[k][l] = m.v[k][least][l];
        variance[l] = m.a[least][least][l];
    }
}

/* Keys ascend, so the neighbours of successive voxels do too: nine positions that only move forward replace 27 searches.
 *
 * keys: of the voxels, ascending (count). moments: (count, MOMENTS). weights: of a neighbour, by the number of axes along which it is
 * displaced (4). fewest: least number of points in a voxel and its neighbours together. Results, one for each voxel: around, this
 * number; normals (count, 3) and thickness_m, not set where around is less than fewest. */
WIDE void streetfix_surfels(const int64_t *keys, const float *moments, int64_t count, double voxel_m, const double *weights, double fewest,
                            double *around, float *normals, float *thickness_m)
{
    int64_t at[COLUMNS], away[COLUMNS], voxel[LANES];
    double waiting[10][LANES];
    int filled = 0;
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
        if (points >= fewest) {
            for (int k = 0; k < 10; k++) waiting[k][filled] = total[k];
            voxel[filled++] = i;
        }
        if (filled == LANES || (filled > 0 && i == count - 1)) {
            for (int l = filled; l < LANES; l++)
                for (int k = 0; k < 10; k++) waiting[k][l] = k == 0; /* lanes without a voxel */
            double axis[3][LANES], variance[LANES];
            least_axes(waiting, axis, variance);
            for (int l = 0; l < filled; l++) {
                for (int k = 0; k < 3; k++) normals[3 * voxel[l] + k] = (float)axis[k][l];
                thickness_m[voxel[l]] = (float)sqrt(variance[l] > 0 ? variance[l] : 0);
            }
            filled = 0;
        }
    }
}
