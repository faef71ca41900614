/* Casts the rays of a small image on the map's surfels, and sums the normal equations of its inverse depths; see visibility.py and rays.py.
 *
 * Plain C without global state, so several threads may call it at once. Python checks sizes and pointers. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "surfel.h"
#include "wide.h"

#define UNKNOWNS 8 /* translation, rotation (left increment about the reference), log scale, disparity offset */

typedef struct {
    double R[9], t[3]; /* T_map_camera */
    double fx, fy, cx, cy; /* of the small image, px */
    int64_t width, height;
} View;

typedef struct {
    double radius; /* radius of a surfel's disc, m */
    double nearest, reach; /* least and largest depth that counts, m */
    double behind; /* discs up to this depth behind the first one may be the same surface, m */
    double grazing; /* least cosine between normal and line of sight; discs seen flatter are ignored */
} Discs;

/* A surfel in the camera's axes, and the range of pixels that it may cover. The caller provides the memory. */
typedef struct {
    float xyz[3], normal[3];
    int32_t number;
    int32_t left, right, top, bottom; /* pixels, both ends included */
} Disc;

/* Ceiling of ``edge``, but at least 0. */
static inline int32_t from(float edge)
{
    const int32_t whole = edge > 0 ? (edge < 1e9f ? (int32_t)edge : 1000000000) : 0;
    return whole + ((float)whole < edge);
}

/* Floor of ``edge``, but at least 0 and at most ``last``. */
static inline int32_t up_to(float edge, float last)
{
    return (int32_t)(edge < last ? (edge > 0 ? edge : 0) : last);
}

static inline float at_least(float number, float least)
{
    return number > least ? number : least;
}

/* A camera in single precision, with the sides of its field of view: left z <= x <= right z and top z <= y <= bottom z. */
typedef struct {
    float r[9], t[3], fx, fy, cx, cy, ifx, ify, left, right, top, bottom;
} Sides;

static inline Sides sides_of(const View *v)
{
    Sides s;
    for (int i = 0; i < 9; i++) s.r[i] = (float)v->R[i];
    for (int i = 0; i < 3; i++) s.t[i] = (float)v->t[i];
    s.fx = (float)v->fx, s.fy = (float)v->fy, s.cx = (float)v->cx, s.cy = (float)v->cy;
    s.ifx = (float)(1.0 / v->fx), s.ify = (float)(1.0 / v->fy);
    s.left = -s.cx * s.ifx, s.right = ((float)(v->width - 1) - s.cx) * s.ifx;
    s.top = -s.cy * s.ify, s.bottom = ((float)(v->height - 1) - s.cy) * s.ify;
    return s;
}

/* Surfels per chunk. A chunk stays in the processor's cache, and its loops are vectorised. */
enum { CHUNK = 512 };

/* Selects, of at most CHUNK surfels, those whose discs may be visible from a camera within ``near_m`` and ``near_rad`` of the view. Writes
 * their places in order and returns their number. Such a motion moves a point p by at most near_m + near_rad |p| in the camera's axes. So
 * each plane of the field of view is moved outwards by this and by the disc's radius. */
static inline int in_sight(const Surfel *surfels, int count, const Sides *s, const Discs *o, float near_m, float near_rad, int32_t *places)
{
    const float *r = s->r, radius = (float)o->radius, nearest = (float)o->nearest, reach = (float)o->reach;
    const float wide = 1.0f + at_least(-s->left, s->right), tall = 1.0f + at_least(-s->top, s->bottom);
    int32_t seen[CHUNK];
    for (int i = 0; i < count; i++) {
        const Surfel *m = surfels + i;
        const float dx = m->xyz[0] - s->t[0], dy = m->xyz[1] - s->t[1], dz = m->xyz[2] - s->t[2];
        const float z = r[2] * dx + r[5] * dy + r[8] * dz, x = r[0] * dx + r[3] * dy + r[6] * dz, y = r[1] * dx + r[4] * dy + r[7] * dz;
        const float slack = near_m + near_rad * sqrtf(dx * dx + dy * dy + dz * dz);
        const float beside = (radius + slack) * wide, above = (radius + slack) * tall;
        seen[i] = (z >= nearest - slack) & (z <= reach + slack) & (x >= s->left * z - beside) & (x <= s->right * z + beside) &
                  (y >= s->top * z - above) & (y <= s->bottom * z + above);
    }
    int found = 0;
    for (int i = 0; i < count; i++) {
        places[found] = i;
        found += seen[i];
    }
    return found;
}

static inline int chunk_of(int64_t left)
{
    return left < CHUNK ? (int)left : CHUNK;
}

/* Collects the surfels that may be visible from any camera within ``near_m`` and ``near_rad`` of a view, in the map's order. Copies go to
 * ``kept``, their indices to ``numbers``. Both have room for all surfels of ``parts`` (n, 2): first surfel, number of surfels. Returns
 * how many were collected. */
WIDE int64_t streetfix_gather(const Surfel *surfels, const int64_t *parts, int64_t part_count, const View *v, const Discs *o, double near_m,
                              double near_rad, Surfel *kept, int32_t *numbers)
{
    const Sides s = sides_of(v);
    int32_t places[CHUNK];
    int64_t count = 0;
    for (int64_t p = 0; p < part_count; p++)
        for (int64_t k = parts[2 * p], end = k + parts[2 * p + 1]; k < end; k += CHUNK) {
            const int found = in_sight(surfels + k, chunk_of(end - k), &s, o, (float)near_m, (float)near_rad, places);
            for (int i = 0; i < found; i++, count++) {
                kept[count] = surfels[k + places[i]];
                numbers[count] = (int32_t)(k + places[i]);
            }
        }
    return count;
}

/* A chunk of surfels: positions in the camera's axes, normals still in the map's axes. */
typedef struct {
    int count;
    float x[CHUNK], y[CHUNK], z[CHUNK], nx[CHUNK], ny[CHUNK], nz[CHUNK];
    int32_t number[CHUNK];
} Ahead;

/* Adds to ``seen`` the discs that may cover the centre of a pixel; returns their number. */
static inline int64_t discs_of(const Ahead *m, const Sides *s, const View *v, const Discs *o, Disc *seen)
{
    float nx[CHUNK], ny[CHUNK], nz[CHUNK];
    int32_t left[CHUNK], right[CHUNK], top[CHUNK], bottom[CHUNK], shown[CHUNK];
    const float *r = s->r, radius = (float)o->radius, half = 0.5f * (float)o->nearest, grazing2 = (float)(o->grazing * o->grazing);
    const float width = (float)(v->width - 1), height = (float)(v->height - 1);
    for (int i = 0; i < m->count; i++) {
        const float x = m->x[i], y = m->y[i], z = m->z[i];
        nx[i] = r[0] * m->nx[i] + r[3] * m->ny[i] + r[6] * m->nz[i], ny[i] = r[1] * m->nx[i] + r[4] * m->ny[i] + r[7] * m->nz[i];
        nz[i] = r[2] * m->nx[i] + r[5] * m->ny[i] + r[8] * m->nz[i];
        const float off = nx[i] * x + ny[i] * y + nz[i] * z;
        /* Half extent of the disc along each axis. The projection of this box bounds the disc's pixels. */
        const float wide = radius * sqrtf(at_least(1.0f - nx[i] * nx[i], 0)), tall = radius * sqrtf(at_least(1.0f - ny[i] * ny[i], 0));
        const float deep = radius * sqrtf(at_least(1.0f - nz[i] * nz[i], 0)), close = 1.0f / at_least(z - deep, half),
                    away = 1.0f / (z + deep);
        const float u0 = (x - wide) * (x > wide ? away : close) * s->fx + s->cx,
                    u1 = (x + wide) * (x > -wide ? close : away) * s->fx + s->cx;
        const float v0 = (y - tall) * (y > tall ? away : close) * s->fy + s->cy,
                    v1 = (y + tall) * (y > -tall ? close : away) * s->fy + s->cy;
        left[i] = from(u0), right[i] = up_to(u1, width), top[i] = from(v0), bottom[i] = up_to(v1, height);
        /* The discs of far surfels may lie between the centres of pixels. */
        shown[i] =
            (off * off >= grazing2 * (x * x + y * y + z * z)) & (u1 >= 0) & (v1 >= 0) & (left[i] <= right[i]) & (top[i] <= bottom[i]);
    }
    int64_t count = 0;
    for (int i = 0; i < m->count; i++) {
        const Disc disc = {{m->x[i], m->y[i], m->z[i]}, {nx[i], ny[i], nz[i]}, m->number[i], left[i], right[i], top[i], bottom[i]};
        seen[count] = disc;
        count += shown[i];
    }
    return count;
}

/* Writes to ``met`` (height, width) the index of the surfel on each pixel's ray, -1 for none. Several discs may lie within ``behind`` of
 * the first one on a ray. Of these, the disc with the least distance between its centre and its point on the ray counts. ``surfels`` and
 * ``numbers`` (count) come from streetfix_gather. ``seen`` has room for all of them, ``first`` and ``middle`` for one value per pixel. */
WIDE void streetfix_meet(const Surfel *surfels, const int32_t *numbers, int64_t surfel_count, const View *v, const Discs *o, Disc *seen,
                         float *first, float *middle, int32_t *met)
{
    const int64_t pixels = v->width * v->height;
    for (int64_t i = 0; i < pixels; i++) {
        first[i] = middle[i] = INFINITY;
        met[i] = -1;
    }
    /* Drop discs outside the field of view first, because this test needs no division. */
    const Sides s = sides_of(v);
    const float *r = s.r, cx = s.cx, cy = s.cy, ifx = s.ifx, ify = s.ify, radius = (float)o->radius;
    int64_t count = 0;
    int32_t places[CHUNK];
    Ahead ahead;
    for (int64_t k = 0; k < surfel_count; k += CHUNK) {
        ahead.count = in_sight(surfels + k, chunk_of(surfel_count - k), &s, o, 0, 0, places);
        for (int i = 0; i < ahead.count; i++) {
            const Surfel *m = surfels + k + places[i];
            const float dx = m->xyz[0] - s.t[0], dy = m->xyz[1] - s.t[1], dz = m->xyz[2] - s.t[2];
            ahead.x[i] = r[0] * dx + r[3] * dy + r[6] * dz, ahead.y[i] = r[1] * dx + r[4] * dy + r[7] * dz;
            ahead.z[i] = r[2] * dx + r[5] * dy + r[8] * dz;
            ahead.nx[i] = m->normal[0], ahead.ny[i] = m->normal[1], ahead.nz[i] = m->normal[2];
            ahead.number[i] = numbers[k + places[i]];
        }
        count += discs_of(&ahead, &s, v, o, seen + count);
    }
    const float radius2 = radius * radius, behind = (float)o->behind;
    /* Neither pass branches on its results: most discs cover one or two pixels, so branch prediction would fail. A ray parallel to a disc
     * gives an infinite depth or NaN. Both fail the comparisons. */
    for (int64_t i = 0; i < count; i++) {
        const Disc *d = seen + i;
        const float off = d->normal[0] * d->xyz[0] + d->normal[1] * d->xyz[1] + d->normal[2] * d->xyz[2];
        for (int64_t b = d->top; b <= d->bottom; b++) {
            const float ry = ((float)b - cy) * ify, lean = d->normal[1] * ry + d->normal[2];
            float *row = first + b * v->width;
            for (int64_t a = d->left; a <= d->right; a++) {
                const float rx = ((float)a - cx) * ifx, z = off / (d->normal[0] * rx + lean);
                const float ex = rx * z - d->xyz[0], ey = ry * z - d->xyz[1], ez = z - d->xyz[2], apart = ex * ex + ey * ey + ez * ez;
                const float near = apart <= radius2 ? z : INFINITY;
                row[a] = near < row[a] ? near : row[a];
            }
        }
    }
    for (int64_t i = 0; i < count; i++) {
        const Disc *d = seen + i;
        const float off = d->normal[0] * d->xyz[0] + d->normal[1] * d->xyz[1] + d->normal[2] * d->xyz[2];
        for (int64_t b = d->top; b <= d->bottom; b++) {
            const float ry = ((float)b - cy) * ify, lean = d->normal[1] * ry + d->normal[2];
            for (int64_t a = d->left; a <= d->right; a++) {
                const int64_t at = b * v->width + a;
                const float rx = ((float)a - cx) * ifx, z = off / (d->normal[0] * rx + lean);
                const float ex = rx * z - d->xyz[0], ey = ry * z - d->xyz[1], ez = z - d->xyz[2], apart = ex * ex + ey * ey + ez * ez;
                const int better = (apart <= radius2) & (z <= first[at] + behind) & (apart < middle[at]);
                middle[at] = better ? apart : middle[at];
                met[at] = better ? d->number : met[at];
            }
        }
    }
}

typedef struct {
    double about[3]; /* centre of rotation, surfels' frame, m */
    double scale, offset; /* of the measured depth: 1 / z = scale / true z - offset x unit */
    double unit; /* inverse depth per unit of the offset, 1/(px m): 1 / (focal length x baseline) */
    double noise; /* standard deviation of an inverse depth, 1/m */
    double surface; /* standard deviation of the map's surfaces along a ray, m */
    double robust; /* width of the robust kernel, in standard deviations: there a pixel keeps a quarter of its weight */
    double shared; /* standard deviation of the error that the pixels of a patch share, 1/m */
    double moved; /* standard deviation of the distance that a dynamic object may have moved, m */
    double nearest, reach; /* least and largest depth that counts, m */
    double grazing; /* least |normal . ray| of a ray with z = 1 */
    int64_t patch; /* edge of a patch, px */
} Asked;

/* Rows of a pixel: derivatives of the model by the unknowns (0 .. 7), residual (8), derivative by the patch's shared error (9). */
enum { RESIDUAL = UNKNOWNS, OWN, ROWS, LANES = 8, MOST_PIXELS = 256 };

/* service/compiled.py compares this table with Python's structures when it loads the library. */
/* clang-format off */
const LayoutEntry streetfix_layout[] = {
    SURFEL_LAYOUT,
    LAYOUT_STRUCT(View), LAYOUT_FIELD(View, R), LAYOUT_FIELD(View, t), LAYOUT_FIELD(View, fx), LAYOUT_FIELD(View, fy),
    LAYOUT_FIELD(View, cx), LAYOUT_FIELD(View, cy), LAYOUT_FIELD(View, width), LAYOUT_FIELD(View, height),
    LAYOUT_STRUCT(Discs), LAYOUT_FIELD(Discs, radius), LAYOUT_FIELD(Discs, nearest), LAYOUT_FIELD(Discs, reach),
    LAYOUT_FIELD(Discs, behind), LAYOUT_FIELD(Discs, grazing),
    LAYOUT_STRUCT(Disc), LAYOUT_FIELD(Disc, xyz), LAYOUT_FIELD(Disc, normal), LAYOUT_FIELD(Disc, number),
    LAYOUT_FIELD(Disc, left), LAYOUT_FIELD(Disc, right), LAYOUT_FIELD(Disc, top), LAYOUT_FIELD(Disc, bottom),
    LAYOUT_STRUCT(Asked), LAYOUT_FIELD(Asked, about), LAYOUT_FIELD(Asked, scale), LAYOUT_FIELD(Asked, offset),
    LAYOUT_FIELD(Asked, unit), LAYOUT_FIELD(Asked, noise), LAYOUT_FIELD(Asked, surface), LAYOUT_FIELD(Asked, robust),
    LAYOUT_FIELD(Asked, shared), LAYOUT_FIELD(Asked, moved), LAYOUT_FIELD(Asked, nearest), LAYOUT_FIELD(Asked, reach),
    LAYOUT_FIELD(Asked, grazing), LAYOUT_FIELD(Asked, patch),
    LAYOUT_CONSTANT(UNKNOWNS), LAYOUT_CONSTANT(MOST_PIXELS),
    LAYOUT_END,
};
/* clang-format on */

/* The pixels of a patch, padded with zeros to a multiple of LANES. */
typedef struct {
    double rows[ROWS][MOST_PIXELS], weighted[ROWS][MOST_PIXELS];
} Batch;

static inline void add_pixel(const Surfel *m, const View *v, const Asked *q, double x, double y, double inverse, Batch *batch, int *count)
{
    const double rx = (x - v->cx) / v->fx, ry = (y - v->cy) / v->fy, *R = v->R;
    const double ray[3] = {R[0] * rx + R[1] * ry + R[2], R[3] * rx + R[4] * ry + R[5], R[6] * rx + R[7] * ry + R[8]};
    const double nx = m->normal[0], ny = m->normal[1], nz = m->normal[2];
    const double along = nx * ray[0] + ny * ray[1] + nz * ray[2];
    const double off = nx * (m->xyz[0] - v->t[0]) + ny * (m->xyz[1] - v->t[1]) + nz * (m->xyz[2] - v->t[2]), z = off / along;
    if (!(fabs(along) >= q->grazing) || !(z >= q->nearest && z <= q->reach)) return;
    const double near = along / off, k = q->scale * near * near / along;
    const double arm[3] = {v->t[0] + z * ray[0] - q->about[0], v->t[1] + z * ray[1] - q->about[1], v->t[2] + z * ray[2] - q->about[2]};
    const double r = inverse - (q->scale * near - q->offset * q->unit);
    const double g[ROWS] = {k * nx,
                            k * ny,
                            k * nz,
                            k * (arm[1] * nz - arm[2] * ny),
                            k * (arm[2] * nx - arm[0] * nz),
                            k * (arm[0] * ny - arm[1] * nx),
                            q->scale * near,
                            -q->unit,
                            r,
                            1.0};
    const double rough = q->surface * near * near, variance = q->noise * q->noise + rough * rough;
    const double k2 = q->robust * q->robust * variance, damp = k2 / (k2 + r * r), w = damp * damp / variance;
    for (int a = 0; a < ROWS; a++) {
        batch->rows[a][*count] = g[a];
        batch->weighted[a][*count] = w * g[a];
    }
    ++*count;
}

static inline double product(const double *one, const double *other, int count)
{
    double sums[LANES] = {0}, sum = 0;
    for (int k = 0; k < count; k += LANES)
        for (int l = 0; l < LANES; l++) sums[l] += one[k + l] * other[k + l];
    for (int l = 0; l < LANES; l++) sum += sums[l];
    return sum;
}

/* Adds the normal equations of one image to H (8, 8) and b (8). Writes the gradient of each patch to ``pulls`` (patches, 8): the sum of
 * weight x residual x derivative. The shared error of each patch is one unknown with a prior, marginalised by the Schur complement.
 * ``inverse`` (height, width): measured 1 / z, 0 for none. A patch has at most MOST_PIXELS pixels. Adds half the
 * weighted squared residuals to ``error``. Returns the number of pixels used. */
WIDE int64_t streetfix_pull(const Surfel *surfels, const View *v, const int32_t *met, const float *inverse, const uint8_t *movable,
                            const Asked *q, double *H, double *b, double *pulls, double *error)
{
    Batch batch;
    int64_t pixels = 0;
    for (int64_t top = 0; top < v->height; top += q->patch)
        for (int64_t left = 0; left < v->width; left += q->patch, pulls += UNKNOWNS) {
            int count = 0;
            double moved = 0;
            for (int64_t y = top; y < top + q->patch && y < v->height; y++)
                for (int64_t x = left; x < left + q->patch && x < v->width; x++) {
                    const int64_t i = y * v->width + x;
                    if (met[i] < 0 || !(inverse[i] > 0)) continue;
                    const int before = count;
                    add_pixel(surfels + met[i], v, q, (double)x, (double)y, (double)inverse[i], &batch, &count);
                    if (count > before && movable[i]) moved += pow((double)inverse[i], 4);
                }
            if (count == 0) continue;
            const int whole = (count + LANES - 1) / LANES * LANES;
            for (int a = 0; a < ROWS; a++)
                for (int k = count; k < whole; k++) batch.rows[a][k] = batch.weighted[a][k] = 0;
            double own[ROWS];
            for (int a = 0; a < ROWS; a++) own[a] = product(batch.weighted[OWN], batch.rows[a], whole);
            const double common = q->shared * q->shared + q->moved * q->moved * moved / count;
            const double share = common > 0 ? 1.0 / (own[OWN] + 1.0 / common) : 0.0;
            for (int a = 0; a < UNKNOWNS; a++) {
                for (int c = 0; c <= a; c++) {
                    const double told = product(batch.weighted[a], batch.rows[c], whole) - share * own[a] * own[c];
                    H[UNKNOWNS * a + c] += told;
                    if (c < a) H[UNKNOWNS * c + a] += told;
                }
                pulls[a] = product(batch.weighted[RESIDUAL], batch.rows[a], whole) - share * own[a] * own[RESIDUAL];
                b[a] += pulls[a];
            }
            *error += 0.5 * (product(batch.weighted[RESIDUAL], batch.rows[RESIDUAL], whole) - share * own[RESIDUAL] * own[RESIDUAL]);
            pixels += count;
        }
    return pixels;
}
