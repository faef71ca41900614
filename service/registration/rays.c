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
static inline int32_t from(double edge)
{
    const int32_t whole = edge > 0 ? (int32_t)edge : 0;
    return whole + ((double)whole < edge);
}

static inline int32_t up_to(double edge, int64_t size)
{
    return (int32_t)(edge < (double)(size - 1) ? edge : (double)(size - 1));
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
    const double *R = v->R;
    const double left = -v->cx / v->fx, right = ((double)(v->width - 1) - v->cx) / v->fx;
    const double top = -v->cy / v->fy, bottom = ((double)(v->height - 1) - v->cy) / v->fy;
    const double beside = o->radius * (1.0 + fmax(-left, right)), above = o->radius * (1.0 + fmax(-top, bottom));
    int64_t count = 0;
    for (int64_t p = 0; p < part_count; p++)
        for (int64_t k = parts[2 * p]; k < parts[2 * p] + parts[2 * p + 1]; k++) {
            const Surfel *m = surfels + k;
            const double dx = m->x - v->t[0], dy = m->y - v->t[1], dz = m->z - v->t[2];
            const double z = R[2] * dx + R[5] * dy + R[8] * dz, x = R[0] * dx + R[3] * dy + R[6] * dz, y = R[1] * dx + R[4] * dy + R[7] * dz;
            if (!((z >= o->nearest) & (z <= o->reach) & (x >= left * z - beside) & (x <= right * z + beside) & (y >= top * z - above) &
                  (y <= bottom * z + above))) continue;
            const double nx = R[0] * m->nx + R[3] * m->ny + R[6] * m->nz, ny = R[1] * m->nx + R[4] * m->ny + R[7] * m->nz;
            const double nz = R[2] * m->nx + R[5] * m->ny + R[8] * m->nz, off = nx * x + ny * y + nz * z;
            if (off * off < o->grazing * o->grazing * (x * x + y * y + z * z)) continue;
            /* How far the disc reaches along each axis; its picture lies between those of the corners of that box. */
            const double wide = o->radius * sqrt(fmax(1.0 - nx * nx, 0)), tall = o->radius * sqrt(fmax(1.0 - ny * ny, 0));
            const double deep = o->radius * sqrt(fmax(1.0 - nz * nz, 0)), close = 1.0 / fmax(z - deep, 0.5 * o->nearest), away = 1.0 / (z + deep);
            const double u0 = (x - wide) * (x > wide ? away : close) * v->fx + v->cx, u1 = (x + wide) * (x > -wide ? close : away) * v->fx + v->cx;
            const double v0 = (y - tall) * (y > tall ? away : close) * v->fy + v->cy, v1 = (y + tall) * (y > -tall ? close : away) * v->fy + v->cy;
            if (!(u1 >= 0 && u0 <= (double)(v->width - 1) && v1 >= 0 && v0 <= (double)(v->height - 1))) continue;
            seen[count++] = (Disc){(float)x, (float)y, (float)z, (float)nx, (float)ny, (float)nz, (int32_t)k, from(u0),
                                   up_to(u1, v->width), from(v0), up_to(v1, v->height)};
        }
    const float radius2 = (float)(o->radius * o->radius), behind = (float)o->behind;
    const float cx = (float)v->cx, cy = (float)v->cy, ifx = (float)(1.0 / v->fx), ify = (float)(1.0 / v->fy);
    for (int pass = 0; pass < 2; pass++)
        for (int64_t i = 0; i < count; i++) {
            const Disc *s = seen + i;
            const float off = s->nx * s->x + s->ny * s->y + s->nz * s->z;
            for (int64_t b = s->top; b <= s->bottom; b++)
                for (int64_t a = s->left; a <= s->right; a++) {
                    const float rx = ((float)a - cx) * ifx, ry = ((float)b - cy) * ify, z = off / (s->nx * rx + s->ny * ry + s->nz);
                    const float ex = rx * z - s->x, ey = ry * z - s->y, ez = z - s->z, apart = ex * ex + ey * ey + ez * ez;
                    if (!(apart <= radius2)) continue; /* nor where the ray runs along the disc */
                    const int64_t at = b * v->width + a;
                    if (pass == 0) {
                        if (z < first[at]) first[at] = z;
                    } else if (z <= first[at] + behind && apart < middle[at]) {
                        middle[at] = apart;
                        met[at] = s->number;
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
    double nearest, reach;  /* m */
    double grazing;         /* cosine, as in Discs */
    int64_t patch;          /* pixels along its edge */
} Asked;

/* One pixel: what its residual does with the unknowns (0 .. 7), the residual (8), what its patch's own error does with it (9). */
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
WIDE int64_t streetfix_pull(const Surfel *surfels, const View *v, const int32_t *met, const float *inverse, const Asked *q, double *H, double *b,
                            double *pulls)
{
    Batch batch;
    int64_t pixels = 0;
    for (int64_t top = 0; top < v->height; top += q->patch)
        for (int64_t left = 0; left < v->width; left += q->patch, pulls += UNKNOWNS) {
            int count = 0;
            for (int64_t y = top; y < top + q->patch && y < v->height; y++)
                for (int64_t x = left; x < left + q->patch && x < v->width; x++) {
                    const int64_t i = y * v->width + x;
                    if (met[i] >= 0 && inverse[i] > 0)
                        add_pixel(surfels + met[i], v, q, (double)x, (double)y, (double)inverse[i], &batch, &count);
                }
            if (count == 0) continue;
            const int whole = (count + LANES - 1) / LANES * LANES;
            for (int a = 0; a < ROWS; a++)
                for (int k = count; k < whole; k++) batch.rows[a][k] = batch.weighted[a][k] = 0;
            double own[ROWS];
            for (int a = 0; a < ROWS; a++) own[a] = product(batch.weighted[OWN], batch.rows[a], whole);
            const double share = q->shared > 0 ? 1.0 / (own[OWN] + 1.0 / (q->shared * q->shared)) : 0.0;
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
