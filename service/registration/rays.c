/* Where the rays of a small picture meet the map's surfels, and what its depths then say about its pose; see rays.py.
 *
 * Plain C without global state: callable from several threads at once. Sizes and pointers are checked in Python. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "surfel.h"
#include "wide.h"

#define UNKNOWNS 8 /* translation, rotation (left increment about the reference), log scale, disparity offset */

typedef struct {
    double R[9], t[3];     /* T_map_camera */
    double fx, fy, cx, cy; /* of the small picture */
    int64_t width, height;
} View;

typedef struct {
    double radius;       /* m: of the disc that a surfel is */
    double nearest, reach; /* m: of depths that count */
    double behind;       /* m: discs so far behind the first one may be the same surface */
    double grazing;      /* cosine: discs seen flatter than this are not met */
} Discs;

/* A surfel in the camera's axes, and the pixels that it may cover; room for as many as may be in view is given by whoever calls. */
typedef struct {
    float x, y, z, nx, ny, nz;
    int32_t number;
    int32_t left, right, top, bottom;
} Disc;

/* From the least whole number that is not below a number, and not below 0. */
static inline int32_t from(float edge)
{
    const int32_t whole = edge > 0 ? (edge < 1e9f ? (int32_t)edge : 1000000000) : 0;
    return whole + ((float)whole < edge);
}

static inline int32_t up_to(float edge, int64_t size)
{
    return (int32_t)(edge < (float)(size - 1) ? edge : (float)(size - 1));
}

/* met (height, width): the surfel on each pixel's ray, -1 for none; of discs that overlap near the first one met, that whose middle is
 * nearest to the ray. ``parts`` (n, 2): first surfel and count of what may be in view; ``seen`` has room for all of them, ``first`` and
 * ``middle`` for a number a pixel. */
WIDE void streetfix_meet(const Surfel *surfels, const int64_t *parts, int64_t part_count, const View *v, const Discs *o, Disc *seen,
                    float *first, float *middle, int32_t *met)
{
    const int64_t pixels = v->width * v->height;
    for (int64_t i = 0; i < pixels; i++) {
        first[i] = middle[i] = INFINITY;
        met[i] = -1;
    }
    /* What is beside the picture is left out before anything is divided; a disc reaches its radius over its middle, across and ahead. */
    float r[9];
    for (int i = 0; i < 9; i++) r[i] = (float)v->R[i];
    const float tx = (float)v->t[0], ty = (float)v->t[1], tz = (float)v->t[2], fx = (float)v->fx, fy = (float)v->fy;
    const float cx = (float)v->cx, cy = (float)v->cy, ifx = (float)(1.0 / v->fx), ify = (float)(1.0 / v->fy);
    const float radius = (float)o->radius, nearest = (float)o->nearest, reach = (float)o->reach, grazing2 = (float)(o->grazing * o->grazing);
    const float left = -cx * ifx, right = ((float)(v->width - 1) - cx) * ifx;
    const float top = -cy * ify, bottom = ((float)(v->height - 1) - cy) * ify;
    const float beside = radius * (1.0f + fmaxf(-left, right)), above = radius * (1.0f + fmaxf(-top, bottom));
    int64_t count = 0;
    for (int64_t p = 0; p < part_count; p++)
        for (int64_t k = parts[2 * p]; k < parts[2 * p] + parts[2 * p + 1]; k++) {
            const Surfel *m = surfels + k;
            const float dx = m->x - tx, dy = m->y - ty, dz = m->z - tz;
            const float z = r[2] * dx + r[5] * dy + r[8] * dz, x = r[0] * dx + r[3] * dy + r[6] * dz, y = r[1] * dx + r[4] * dy + r[7] * dz;
            if (!((z >= nearest) & (z <= reach) & (x >= left * z - beside) & (x <= right * z + beside) & (y >= top * z - above) &
                  (y <= bottom * z + above))) continue;
            const float nx = r[0] * m->nx + r[3] * m->ny + r[6] * m->nz, ny = r[1] * m->nx + r[4] * m->ny + r[7] * m->nz;
            const float nz = r[2] * m->nx + r[5] * m->ny + r[8] * m->nz, off = nx * x + ny * y + nz * z;
            if (off * off < grazing2 * (x * x + y * y + z * z)) continue;
            /* How far the disc reaches along each axis; its picture lies between those of the corners of that box. */
            const float wide = radius * sqrtf(fmaxf(1.0f - nx * nx, 0)), tall = radius * sqrtf(fmaxf(1.0f - ny * ny, 0));
            const float deep = radius * sqrtf(fmaxf(1.0f - nz * nz, 0)), close = 1.0f / fmaxf(z - deep, 0.5f * nearest), away = 1.0f / (z + deep);
            const float u0 = (x - wide) * (x > wide ? away : close) * fx + cx, u1 = (x + wide) * (x > -wide ? close : away) * fx + cx;
            const float v0 = (y - tall) * (y > tall ? away : close) * fy + cy, v1 = (y + tall) * (y > -tall ? close : away) * fy + cy;
            if (!(u1 >= 0 && u0 <= (float)(v->width - 1) && v1 >= 0 && v0 <= (float)(v->height - 1))) continue;
            const Disc disc = {x, y, z, nx, ny, nz, (int32_t)k, from(u0), up_to(u1, v->width), from(v0), up_to(v1, v->height)};
            seen[count] = disc;
            count += (disc.left <= disc.right) & (disc.top <= disc.bottom); /* far ones may lie between the pixels' middles */
        }
    const float radius2 = radius * radius, behind = (float)o->behind;
    /* Neither pass branches on what it finds: most discs cover a pixel or two, so a processor could only guess. A ray along a disc gives
     * no number or an infinite one, which nothing is nearer than. */
    for (int64_t i = 0; i < count; i++) {
        const Disc *s = seen + i;
        const float off = s->nx * s->x + s->ny * s->y + s->nz * s->z;
        for (int64_t b = s->top; b <= s->bottom; b++) {
            const float ry = ((float)b - cy) * ify, lean = s->ny * ry + s->nz;
            float *row = first + b * v->width;
            for (int64_t a = s->left; a <= s->right; a++) {
                const float rx = ((float)a - cx) * ifx, z = off / (s->nx * rx + lean);
                const float ex = rx * z - s->x, ey = ry * z - s->y, ez = z - s->z, apart = ex * ex + ey * ey + ez * ez;
                const float near = apart <= radius2 ? z : INFINITY;
                row[a] = near < row[a] ? near : row[a];
            }
        }
    }
    for (int64_t i = 0; i < count; i++) {
        const Disc *s = seen + i;
        const float off = s->nx * s->x + s->ny * s->y + s->nz * s->z;
        for (int64_t b = s->top; b <= s->bottom; b++) {
            const float ry = ((float)b - cy) * ify, lean = s->ny * ry + s->nz;
            for (int64_t a = s->left; a <= s->right; a++) {
                const int64_t at = b * v->width + a;
                const float rx = ((float)a - cx) * ifx, z = off / (s->nx * rx + lean);
                const float ex = rx * z - s->x, ey = ry * z - s->y, ez = z - s->z, apart = ex * ex + ey * ey + ez * ez;
                const int better = (apart <= radius2) & (z <= first[at] + behind) & (apart < middle[at]);
                middle[at] = better ? apart : middle[at];
                met[at] = better ? s->number : met[at];
            }
        }
    }
}

typedef struct {
    double about[3];        /* what rotations turn about, in the map */
    double scale, offset;   /* of the depths: 1 / z = scale / true z - offset */
    double unit;            /* of the offset, 1/m */
    double noise;           /* standard deviation of an inverse depth, 1/m */
    double surface;         /* m: how far the map's surfaces may be off along a ray */
    double robust;          /* standard deviations at which a residual weighs a quarter */
    double shared;          /* standard deviation of the error that a patch has in common, 1/m */
    double moved;           /* m: standard deviation of how far what may move stands from where it was mapped */
    double nearest, reach;  /* m */
    double grazing;         /* cosine, as in Discs */
    int64_t patch;          /* pixels along its edge */
} Asked;

/* One pixel: what its residual does with the unknowns (0 .. 7), the residual (8), by how much its patch's own error, of
 * deviation 1, is felt in it (9). */
enum { RESIDUAL = UNKNOWNS, OWN, ROWS, LANES = 8, MOST = 256 };

/* A patch's pixels side by side, as many as there are and zeros up to whole lanes. */
typedef struct {
    double rows[ROWS][MOST], weighted[ROWS][MOST];
} Batch;

static inline void add_pixel(const Surfel *m, const View *v, const Asked *q, double x, double y, double inverse, Batch *batch, int *count)
{
    const double rx = (x - v->cx) / v->fx, ry = (y - v->cy) / v->fy, *R = v->R;
    const double ray[3] = {R[0] * rx + R[1] * ry + R[2], R[3] * rx + R[4] * ry + R[5], R[6] * rx + R[7] * ry + R[8]};
    const double along = m->nx * ray[0] + m->ny * ray[1] + m->nz * ray[2];
    const double off = m->nx * (m->x - v->t[0]) + m->ny * (m->y - v->t[1]) + m->nz * (m->z - v->t[2]), z = off / along;
    if (!(fabs(along) >= q->grazing) || !(z >= q->nearest && z <= q->reach)) return;
    const double near = along / off, k = q->scale * near * near / along;
    const double arm[3] = {v->t[0] + z * ray[0] - q->about[0], v->t[1] + z * ray[1] - q->about[1], v->t[2] + z * ray[2] - q->about[2]};
    const double r = inverse - (q->scale * near - q->offset * q->unit);
    const double g[ROWS] = {k * m->nx, k * m->ny, k * m->nz, k * (arm[1] * m->nz - arm[2] * m->ny), k * (arm[2] * m->nx - arm[0] * m->nz),
                            k * (arm[0] * m->ny - arm[1] * m->nx), q->scale * near, -q->unit, r, 1.0};
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

/* H (8, 8) and b (8) of the normal equations of one picture, added to what is there, and the pull of each patch (patches, 8): sums of
 * gradients by residuals. Each patch's own common error is taken out, as one unknown a patch under a prior, by Schur's complement.
 * ``inverse`` (height, width): measured 1 / z, 0 for none. A patch has at most MOST pixels. Returns how many pixels took part. */
WIDE int64_t streetfix_pull(const Surfel *surfels, const View *v, const int32_t *met, const float *inverse, const uint8_t *movable, const Asked *q,
                            double *H, double *b, double *pulls)
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
            pixels += count;
        }
    return pixels;
}
