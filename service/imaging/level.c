/* Fits the ground of a depth image: a plane z = a x + b y + c in the nominal level frame, by least squares under a prior. Each round
 * keeps the points in an inlier band around the plane of the previous round.
 *
 * Python checks sizes. `points` has room for every pixel that is read. */

#include <math.h>
#include <stdint.h>

#include "picture.h"

typedef struct {
    double near_m, reach_m, below_m;                /* limits of depth z; a ground point lies below -below_m */
    double height_m, tilt_prior, height_prior_m;    /* prior: offset is -height_m; sigmas of slopes and offset */
    double noise_m, noise_per_m, correlated;        /* sigma across the plane: constant, per metre; points counted as one */
} Ground;

typedef struct {
    double x, y, z, reach, weight;
} Point;

/* Compared with Python's structures when the library is loaded. */
/* clang-format off */
const LayoutEntry streetfix_layout[] = {
    PICTURE_LAYOUT,
    LAYOUT_STRUCT(Ground), LAYOUT_FIELD(Ground, near_m), LAYOUT_FIELD(Ground, reach_m), LAYOUT_FIELD(Ground, below_m),
    LAYOUT_FIELD(Ground, height_m), LAYOUT_FIELD(Ground, tilt_prior), LAYOUT_FIELD(Ground, height_prior_m),
    LAYOUT_FIELD(Ground, noise_m), LAYOUT_FIELD(Ground, noise_per_m), LAYOUT_FIELD(Ground, correlated),
    LAYOUT_STRUCT(Point), LAYOUT_FIELD(Point, x), LAYOUT_FIELD(Point, y), LAYOUT_FIELD(Point, z),
    LAYOUT_FIELD(Point, reach), LAYOUT_FIELD(Point, weight),
    LAYOUT_END,
};
/* clang-format on */

/* Solves H s = g for a symmetric, positive definite H (lower triangle given) by Cholesky decomposition. */
static void solve(double H[3][3], const double g[3], double s[3])
{
    double L[3][3] = {{0}};
    for (int i = 0; i < 3; i++)
        for (int j = 0; j <= i; j++) {
            double v = H[i][j];
            for (int k = 0; k < j; k++) v -= L[i][k] * L[j][k];
            L[i][j] = i == j ? sqrt(v) : v / L[j][j];
        }
    double y[3];
    for (int i = 0; i < 3; i++) {
        y[i] = g[i];
        for (int k = 0; k < i; k++) y[i] -= L[i][k] * y[k];
        y[i] /= L[i][i];
    }
    for (int i = 2; i >= 0; i--) {
        s[i] = y[i];
        for (int k = i + 1; k < 3; k++) s[i] -= L[k][i] * s[k];
        s[i] /= L[i][i];
    }
}

/* R: rotation from the optical frame to the nominal level frame, row-major. step: distance between the pixels that are read.
 * bands: a, b, c for each round. At the horizontal distance r, a point may lie a + b r below the plane and c (a + b r) above it (metres).
 * out: slopes a, b and offset c (metres) of the plane; then the number of pixels with a depth in the limits, of those in the last band around
 * the plane, and of those more than three times the last band below it. */
void streetfix_fit_ground(const float *depth, const Picture *p, int64_t step, const double *R, const Ground *o, const double *bands,
                          int64_t rounds, Point *points, double *out)
{
    int64_t count = 0, measured = 0, on_plane = 0, below = 0;
    for (int64_t v = step / 2; v < p->height; v += step)
        for (int64_t u = step / 2; u < p->width; u += step) {
            const double z = (double)depth[v * p->width + u];
            if (!(z > o->near_m && z < o->reach_m)) continue;
            measured++;
            const double cx = z * (((double)u - p->cx) / p->fx), cy = z * (((double)v - p->cy) / p->fy);
            const double up = R[6] * cx + R[7] * cy + R[8] * z;
            if (!(up < -o->below_m)) continue;
            Point *q = points + count++;
            q->x = R[0] * cx + R[1] * cy + R[2] * z;
            q->y = R[3] * cx + R[4] * cy + R[5] * z;
            q->z = up;
            q->reach = hypot(q->x, q->y);
            const double noise = o->noise_m + o->noise_per_m * q->reach;
            q->weight = 1.0 / (noise * noise * o->correlated);
        }
    out[0] = out[1] = 0.0;
    out[2] = -o->height_m;
    const double slope = 1.0 / (o->tilt_prior * o->tilt_prior), offset = 1.0 / (o->height_prior_m * o->height_prior_m);
    for (int64_t k = 0; k < rounds; k++) {
        double H[3][3] = {{slope, 0, 0}, {0, slope, 0}, {0, 0, offset}}, g[3] = {0, 0, -o->height_m * offset};
        int64_t kept = 0;
        for (int64_t i = 0; i < count; i++) {
            const Point *q = points + i;
            const double residual = q->z - (q->x * out[0] + q->y * out[1] + out[2]);
            const double band = bands[3 * k] + bands[3 * k + 1] * q->reach;
            if (!(residual > -band && residual < bands[3 * k + 2] * band)) continue;
            const double w = q->weight, wx = w * q->x, wy = w * q->y;
            H[0][0] += wx * q->x;
            H[1][0] += wy * q->x;
            H[1][1] += wy * q->y;
            H[2][0] += wx;
            H[2][1] += wy;
            H[2][2] += w;
            g[0] += wx * q->z;
            g[1] += wy * q->z;
            g[2] += w * q->z;
            kept++;
        }
        if (kept == 0) break;
        solve(H, g, out);
    }
    for (int64_t i = 0; i < count; i++) {
        const Point *q = points + i;
        const double residual = q->z - (q->x * out[0] + q->y * out[1] + out[2]);
        const double band = bands[3 * rounds - 3] + bands[3 * rounds - 2] * q->reach;
        on_plane += fabs(residual) <= band;
        below += residual < -3 * band;
    }
    out[3] = (double)measured;
    out[4] = (double)on_plane;
    out[5] = (double)below;
}
