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
    double same_surface; /* discs up to this depth behind the first one may be the same surface, m */
    double grazing; /* least cosine between normal and line of sight; discs seen flatter are ignored */
} Discs;

/* A surfel in the camera's axes, and the range of pixels that it may cover. The caller provides the memory. */
typedef struct {
    float xyz[3], normal[3];
    int32_t number;
    int32_t left, right, top, bottom; /* pixels, both ends included */
} Disc;

/* Ceiling of ``edge``, but at least 0. */
static inline int32_t ceil_pixel(float edge)
{
    const int32_t whole = edge > 0 ? (edge < 1e9f ? (int32_t)edge : 1000000000) : 0;
    return whole + ((float)whole < edge);
}

/* Floor of ``edge``, but at least 0 and at most ``last``. */
static inline int32_t floor_pixel(float edge, float last)
{
    return (int32_t)(edge < last ? (edge > 0 ? edge : 0) : last);
}

static inline float larger_of(float one, float other)
{
    return one > other ? one : other;
}

/* A camera in single precision, with the sides of its field of view: left z <= x <= right z and top z <= y <= bottom z. */
typedef struct {
    float r[9], t[3], fx, fy, cx, cy, ifx, ify, left, right, top, bottom;
} Frustum;

static inline Frustum frustum_of(const View *v)
{
    Frustum s;
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
 * their indices in order and returns their number. Such a motion moves a point p by at most near_m + near_rad |p| in the camera's axes. So
 * each plane of the field of view is moved outwards by this and by the disc's radius. */
static inline int select_visible(const Surfel *surfels, int count, const Frustum *s, const Discs *o, float near_m, float near_rad,
                                 int32_t *indices)
{
    const float *r = s->r, radius = (float)o->radius, nearest = (float)o->nearest, reach = (float)o->reach;
    const float width_factor = 1.0f + larger_of(-s->left, s->right), height_factor = 1.0f + larger_of(-s->top, s->bottom);
    int32_t visible[CHUNK];
    for (int i = 0; i < count; i++) {
        const Surfel *m = surfels + i;
        const float dx = m->xyz[0] - s->t[0], dy = m->xyz[1] - s->t[1], dz = m->xyz[2] - s->t[2];
        const float z = r[2] * dx + r[5] * dy + r[8] * dz, x = r[0] * dx + r[3] * dy + r[6] * dz, y = r[1] * dx + r[4] * dy + r[7] * dz;
        const float motion = near_m + near_rad * sqrtf(dx * dx + dy * dy + dz * dz);
        const float margin_x = (radius + motion) * width_factor, margin_y = (radius + motion) * height_factor;
        visible[i] = (z >= nearest - motion) & (z <= reach + motion) & (x >= s->left * z - margin_x) & (x <= s->right * z + margin_x) &
                     (y >= s->top * z - margin_y) & (y <= s->bottom * z + margin_y);
    }
    int count_visible = 0;
    for (int i = 0; i < count; i++) {
        indices[count_visible] = i;
        count_visible += visible[i];
    }
    return count_visible;
}

static inline int chunk_size(int64_t remaining)
{
    return remaining < CHUNK ? (int)remaining : CHUNK;
}

/* Collects the surfels of some cubes that may be visible from any camera within ``near_m`` and ``near_rad`` of a view, in the map's order.
 * They go to ``collected`` without their thickness and points, and their rows to ``numbers``. Both have room for all surfels of the cubes.
 * ``cell``: edge of a cell, m. Returns the number of collected surfels. */
WIDE int64_t streetfix_collect(const PackedSurfel *surfels, const Cube *cubes, int64_t cube_count, double cell, const View *v,
                               const Discs *o, double near_m, double near_rad, Surfel *collected, int32_t *numbers)
{
    const Frustum s = frustum_of(v);
    const double step = cell / STEPS;
    int32_t indices[CHUNK];
    Surfel chunk[CHUNK];
    int64_t count = 0;
    for (int64_t c = 0; c < cube_count; c++) {
        const double *corner = cubes[c].corner;
        for (int64_t k = cubes[c].first, end = k + cubes[c].count; k < end; k += CHUNK) {
            const int size = chunk_size(end - k);
            for (int i = 0; i < size; i++)
                for (int a = 0; a < 3; a++) chunk[i].xyz[a] = (float)(corner[a] + step * surfels[k + i].xyz[a]);
            const int visible = select_visible(chunk, size, &s, o, (float)near_m, (float)near_rad, indices);
            for (int i = 0; i < visible; i++, count++) {
                for (int a = 0; a < 3; a++) collected[count].xyz[a] = chunk[indices[i]].xyz[a];
                unpack_normal(surfels[k + indices[i]].normal, collected[count].normal);
                numbers[count] = (int32_t)(k + indices[i]);
            }
        }
    }
    return count;
}

/* A chunk of surfels: positions in the camera's axes, normals still in the map's axes. */
typedef struct {
    int count;
    float x[CHUNK], y[CHUNK], z[CHUNK], nx[CHUNK], ny[CHUNK], nz[CHUNK];
    int32_t number[CHUNK];
} Chunk;

/* Adds to ``discs`` the discs that may cover the centre of a pixel; returns their number. */
static inline int64_t project_discs(const Chunk *m, const Frustum *s, const View *v, const Discs *o, Disc *discs)
{
    float nx[CHUNK], ny[CHUNK], nz[CHUNK];
    int32_t left[CHUNK], right[CHUNK], top[CHUNK], bottom[CHUNK], is_visible[CHUNK];
    const float *r = s->r, radius = (float)o->radius, least_z = 0.5f * (float)o->nearest, grazing2 = (float)(o->grazing * o->grazing);
    const float width = (float)(v->width - 1), height = (float)(v->height - 1);
    for (int i = 0; i < m->count; i++) {
        const float x = m->x[i], y = m->y[i], z = m->z[i];
        nx[i] = r[0] * m->nx[i] + r[3] * m->ny[i] + r[6] * m->nz[i], ny[i] = r[1] * m->nx[i] + r[4] * m->ny[i] + r[7] * m->nz[i];
        nz[i] = r[2] * m->nx[i] + r[5] * m->ny[i] + r[8] * m->nz[i];
        const float plane = nx[i] * x + ny[i] * y + nz[i] * z;
        /* Half extent of the disc along each axis. The projection of this box bounds the disc's pixels. */
        const float half_x = radius * sqrtf(larger_of(1.0f - nx[i] * nx[i], 0)),
                    half_y = radius * sqrtf(larger_of(1.0f - ny[i] * ny[i], 0));
        const float half_z = radius * sqrtf(larger_of(1.0f - nz[i] * nz[i], 0)), inverse_near = 1.0f / larger_of(z - half_z, least_z),
                    inverse_far = 1.0f / (z + half_z);
        const float u0 = (x - half_x) * (x > half_x ? inverse_far : inverse_near) * s->fx + s->cx,
                    u1 = (x + half_x) * (x > -half_x ? inverse_near : inverse_far) * s->fx + s->cx;
        const float v0 = (y - half_y) * (y > half_y ? inverse_far : inverse_near) * s->fy + s->cy,
                    v1 = (y + half_y) * (y > -half_y ? inverse_near : inverse_far) * s->fy + s->cy;
        left[i] = ceil_pixel(u0), right[i] = floor_pixel(u1, width), top[i] = ceil_pixel(v0), bottom[i] = floor_pixel(v1, height);
        /* The discs of far surfels may lie between the centres of pixels. */
        is_visible[i] =
            (plane * plane >= grazing2 * (x * x + y * y + z * z)) & (u1 >= 0) & (v1 >= 0) & (left[i] <= right[i]) & (top[i] <= bottom[i]);
    }
    int64_t count = 0;
    for (int i = 0; i < m->count; i++) {
        const Disc disc = {{m->x[i], m->y[i], m->z[i]}, {nx[i], ny[i], nz[i]}, m->number[i], left[i], right[i], top[i], bottom[i]};
        discs[count] = disc;
        count += is_visible[i];
    }
    return count;
}

/* Writes to ``surfel_of`` (height, width) the index of the surfel on each pixel's ray, -1 for none. Several discs may lie within
 * ``same_surface`` of the nearest one on a ray. Of these, the disc whose centre is closest to its point on the ray counts. ``surfels`` and
 * ``numbers`` (count) come from streetfix_collect. Work memory: ``discs`` has room for all surfels. ``nearest`` (depth of the first disc)
 * and ``centre_distance2`` have one value per pixel. */
WIDE void streetfix_intersect(const Surfel *surfels, const int32_t *numbers, int64_t surfel_count, const View *v, const Discs *o,
                              Disc *discs, float *nearest, float *centre_distance2, int32_t *surfel_of)
{
    const int64_t pixels = v->width * v->height;
    for (int64_t i = 0; i < pixels; i++) {
        nearest[i] = centre_distance2[i] = INFINITY;
        surfel_of[i] = -1;
    }
    /* Drop discs outside the field of view first, because this test needs no division. */
    const Frustum s = frustum_of(v);
    const float *r = s.r, cx = s.cx, cy = s.cy, ifx = s.ifx, ify = s.ify, radius = (float)o->radius;
    int64_t count = 0;
    int32_t indices[CHUNK];
    Chunk chunk;
    for (int64_t k = 0; k < surfel_count; k += CHUNK) {
        chunk.count = select_visible(surfels + k, chunk_size(surfel_count - k), &s, o, 0, 0, indices);
        for (int i = 0; i < chunk.count; i++) {
            const Surfel *m = surfels + k + indices[i];
            const float dx = m->xyz[0] - s.t[0], dy = m->xyz[1] - s.t[1], dz = m->xyz[2] - s.t[2];
            chunk.x[i] = r[0] * dx + r[3] * dy + r[6] * dz, chunk.y[i] = r[1] * dx + r[4] * dy + r[7] * dz;
            chunk.z[i] = r[2] * dx + r[5] * dy + r[8] * dz;
            chunk.nx[i] = m->normal[0], chunk.ny[i] = m->normal[1], chunk.nz[i] = m->normal[2];
            chunk.number[i] = numbers[k + indices[i]];
        }
        count += project_discs(&chunk, &s, v, o, discs + count);
    }
    const float radius2 = radius * radius, same_surface = (float)o->same_surface;
    /* Neither pass branches on its results: most discs cover one or two pixels, so branch prediction would fail. A ray parallel to a disc
     * gives an infinite depth or NaN. Both fail the comparisons. */
    for (int64_t i = 0; i < count; i++) {
        const Disc *d = discs + i;
        const float plane = d->normal[0] * d->xyz[0] + d->normal[1] * d->xyz[1] + d->normal[2] * d->xyz[2];
        for (int64_t b = d->top; b <= d->bottom; b++) {
            const float ry = ((float)b - cy) * ify, denominator_y = d->normal[1] * ry + d->normal[2];
            float *row = nearest + b * v->width;
            for (int64_t a = d->left; a <= d->right; a++) {
                const float rx = ((float)a - cx) * ifx, z = plane / (d->normal[0] * rx + denominator_y);
                const float ex = rx * z - d->xyz[0], ey = ry * z - d->xyz[1], ez = z - d->xyz[2], distance2 = ex * ex + ey * ey + ez * ez;
                const float near = distance2 <= radius2 ? z : INFINITY;
                row[a] = near < row[a] ? near : row[a];
            }
        }
    }
    for (int64_t i = 0; i < count; i++) {
        const Disc *d = discs + i;
        const float plane = d->normal[0] * d->xyz[0] + d->normal[1] * d->xyz[1] + d->normal[2] * d->xyz[2];
        for (int64_t b = d->top; b <= d->bottom; b++) {
            const float ry = ((float)b - cy) * ify, denominator_y = d->normal[1] * ry + d->normal[2];
            for (int64_t a = d->left; a <= d->right; a++) {
                const int64_t pixel = b * v->width + a;
                const float rx = ((float)a - cx) * ifx, z = plane / (d->normal[0] * rx + denominator_y);
                const float ex = rx * z - d->xyz[0], ey = ry * z - d->xyz[1], ez = z - d->xyz[2], distance2 = ex * ex + ey * ey + ez * ez;
                const int better = (distance2 <= radius2) & (z <= nearest[pixel] + same_surface) & (distance2 < centre_distance2[pixel]);
                centre_distance2[pixel] = better ? distance2 : centre_distance2[pixel];
                surfel_of[pixel] = better ? d->number : surfel_of[pixel];
            }
        }
    }
}

/* Model of a measured inverse depth. */
typedef struct {
    double centre[3]; /* centre of rotation, surfels' frame, m */
    double scale, offset; /* of the measured depth: 1 / z = scale / true z - offset x per_offset */
    double per_offset; /* inverse depth per unit of the offset, 1/(px m): 1 / (focal length x baseline) */
    double noise; /* standard deviation of an inverse depth, 1/m */
    double surface; /* standard deviation of the map's surfaces along a ray, m */
    double robust; /* width of the robust kernel, in standard deviations: there a pixel keeps a quarter of its weight */
    double shared; /* standard deviation of the error that the pixels of a patch share, 1/m */
    double moved; /* standard deviation of the distance that a dynamic object may have moved, m */
    double nearest, reach; /* least and largest depth that counts, m */
    double grazing; /* least |normal . ray| of a ray with z = 1 */
    int64_t patch; /* edge of a patch, px */
} DepthModel;

/* Rows of a pixel: derivatives of the model by the unknowns (0 .. 7), residual (8), derivative by the patch's shared error (9). */
enum { RESIDUAL = UNKNOWNS, SHARED, ROWS, LANES = 8, MOST_PIXELS = 256 };

/* service/compiled.py compares this table with Python's structures when it loads the library. */
/* clang-format off */
const LayoutEntry streetfix_layout[] = {
    SURFEL_LAYOUT,
    LAYOUT_STRUCT(View), LAYOUT_FIELD(View, R), LAYOUT_FIELD(View, t), LAYOUT_FIELD(View, fx), LAYOUT_FIELD(View, fy),
    LAYOUT_FIELD(View, cx), LAYOUT_FIELD(View, cy), LAYOUT_FIELD(View, width), LAYOUT_FIELD(View, height),
    LAYOUT_STRUCT(Discs), LAYOUT_FIELD(Discs, radius), LAYOUT_FIELD(Discs, nearest), LAYOUT_FIELD(Discs, reach),
    LAYOUT_FIELD(Discs, same_surface), LAYOUT_FIELD(Discs, grazing),
    LAYOUT_STRUCT(Disc), LAYOUT_FIELD(Disc, xyz), LAYOUT_FIELD(Disc, normal), LAYOUT_FIELD(Disc, number),
    LAYOUT_FIELD(Disc, left), LAYOUT_FIELD(Disc, right), LAYOUT_FIELD(Disc, top), LAYOUT_FIELD(Disc, bottom),
    LAYOUT_STRUCT(DepthModel), LAYOUT_FIELD(DepthModel, centre), LAYOUT_FIELD(DepthModel, scale), LAYOUT_FIELD(DepthModel, offset),
    LAYOUT_FIELD(DepthModel, per_offset), LAYOUT_FIELD(DepthModel, noise), LAYOUT_FIELD(DepthModel, surface), LAYOUT_FIELD(DepthModel, robust),
    LAYOUT_FIELD(DepthModel, shared), LAYOUT_FIELD(DepthModel, moved), LAYOUT_FIELD(DepthModel, nearest), LAYOUT_FIELD(DepthModel, reach),
    LAYOUT_FIELD(DepthModel, grazing), LAYOUT_FIELD(DepthModel, patch),
    LAYOUT_CONSTANT(UNKNOWNS), LAYOUT_CONSTANT(MOST_PIXELS),
    LAYOUT_END,
};
/* clang-format on */

/* The pixels of a patch, padded with zeros to a multiple of LANES. */
typedef struct {
    double rows[ROWS][MOST_PIXELS], weighted[ROWS][MOST_PIXELS];
} Batch;

static inline void add_pixel(const Surfel *m, const View *v, const DepthModel *model, double x, double y, double inverse, Batch *batch,
                             int *count)
{
    const double rx = (x - v->cx) / v->fx, ry = (y - v->cy) / v->fy, *R = v->R;
    const double ray[3] = {R[0] * rx + R[1] * ry + R[2], R[3] * rx + R[4] * ry + R[5], R[6] * rx + R[7] * ry + R[8]};
    const double nx = m->normal[0], ny = m->normal[1], nz = m->normal[2];
    const double along = nx * ray[0] + ny * ray[1] + nz * ray[2];
    const double plane = nx * (m->xyz[0] - v->t[0]) + ny * (m->xyz[1] - v->t[1]) + nz * (m->xyz[2] - v->t[2]), z = plane / along;
    if (!(fabs(along) >= model->grazing) || !(z >= model->nearest && z <= model->reach)) return;
    const double inverse_z = along / plane, k = model->scale * inverse_z * inverse_z / along;
    const double arm[3] = {v->t[0] + z * ray[0] - model->centre[0], v->t[1] + z * ray[1] - model->centre[1],
                           v->t[2] + z * ray[2] - model->centre[2]};
    const double residual = inverse - (model->scale * inverse_z - model->offset * model->per_offset);
    const double derivatives[ROWS] = {k * nx,
                                      k * ny,
                                      k * nz,
                                      k * (arm[1] * nz - arm[2] * ny),
                                      k * (arm[2] * nx - arm[0] * nz),
                                      k * (arm[0] * ny - arm[1] * nx),
                                      model->scale * inverse_z,
                                      -model->per_offset,
                                      residual,
                                      1.0};
    const double surface_noise = model->surface * inverse_z * inverse_z,
                 variance = model->noise * model->noise + surface_noise * surface_noise;
    const double k2 = model->robust * model->robust * variance, robust_weight = k2 / (k2 + residual * residual),
                 w = robust_weight * robust_weight / variance;
    for (int a = 0; a < ROWS; a++) {
        batch->rows[a][*count] = derivatives[a];
        batch->weighted[a][*count] = w * derivatives[a];
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

/* Adds the normal equations of one image to H (8, 8) and b (8). Writes the gradient of each patch to ``gradients`` (patches, 8): the sum of
 * weight x residual x derivative. The shared error of each patch is one unknown with a prior, marginalised by the Schur complement.
 * ``surfels`` (height, width): the surfel of each pixel where ``surfel_of`` is not -1. ``inverse``: measured 1 / z, 0 for none. A patch has at most MOST_PIXELS pixels. Adds half the
 * weighted squared residuals to ``error``. Returns the number of pixels used. */
WIDE int64_t streetfix_normal_equations(const Surfel *surfels, const View *v, const int32_t *surfel_of, const float *inverse,
                                        const uint8_t *movable, const DepthModel *model, double *H, double *b, double *gradients,
                                        double *error)
{
    Batch batch;
    int64_t pixels = 0;
    for (int64_t top = 0; top < v->height; top += model->patch)
        for (int64_t left = 0; left < v->width; left += model->patch, gradients += UNKNOWNS) {
            int count = 0;
            double moved = 0;
            for (int64_t y = top; y < top + model->patch && y < v->height; y++)
                for (int64_t x = left; x < left + model->patch && x < v->width; x++) {
                    const int64_t i = y * v->width + x;
                    if (surfel_of[i] < 0 || !(inverse[i] > 0)) continue;
                    const int before = count;
                    add_pixel(surfels + i, v, model, (double)x, (double)y, (double)inverse[i], &batch, &count);
                    if (count > before && movable[i]) moved += pow((double)inverse[i], 4);
                }
            if (count == 0) continue;
            const int padded = (count + LANES - 1) / LANES * LANES;
            for (int a = 0; a < ROWS; a++)
                for (int k = count; k < padded; k++) batch.rows[a][k] = batch.weighted[a][k] = 0;
            double shared[ROWS];
            for (int a = 0; a < ROWS; a++) shared[a] = product(batch.weighted[SHARED], batch.rows[a], padded);
            const double variance = model->shared * model->shared + model->moved * model->moved * moved / count;
            const double reduction = variance > 0 ? 1.0 / (shared[SHARED] + 1.0 / variance) : 0.0;
            for (int a = 0; a < UNKNOWNS; a++) {
                for (int c = 0; c <= a; c++) {
                    const double information = product(batch.weighted[a], batch.rows[c], padded) - reduction * shared[a] * shared[c];
                    H[UNKNOWNS * a + c] += information;
                    if (c < a) H[UNKNOWNS * c + a] += information;
                }
                gradients[a] = product(batch.weighted[RESIDUAL], batch.rows[a], padded) - reduction * shared[a] * shared[RESIDUAL];
                b[a] += gradients[a];
            }
            *error +=
                0.5 * (product(batch.weighted[RESIDUAL], batch.rows[RESIDUAL], padded) - reduction * shared[RESIDUAL] * shared[RESIDUAL]);
            pixels += count;
        }
    return pixels;
}
