/* Weighted, robust point-to-plane registration of a depth picture against a prepared surfel map; see kernel.py.
 *
 * Unknowns, in this order: translation (3), rotation (3, left increment), log scale, disparity offset. A point p of the
 * query (level frame, origin at the camera) stands at  y = s p / (1 + o q)  where q is its depth over focal length times
 * baseline; the world point is R y + t. Plain C without global state: callable from several threads at once.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define UNKNOWNS 8
#define BLOCK 8
#define BLOCK_CELLS (BLOCK * BLOCK * BLOCK)

typedef struct {
    float x, y, z, nx, ny, nz, thickness;
    uint32_t points;
} Surfel;

typedef struct {
    double ox, oy, oz, cell;     /* corner of the grid, metres; edge of a cell */
    int64_t bx, by, bz;          /* blocks along each axis */
    const int32_t *block;        /* (bx, by, bz): number of a block, -1 for none */
    const int32_t *nearest;      /* (blocks, 512): surfel nearest to the cell's centre, -1 for none */
} Grid;

typedef struct {
    int64_t count;
    const float *xyz;    /* (n, 3) level frame */
    const float *ray;    /* (n, 3) unit */
    const float *sigma;  /* (n) standard deviation along the ray, metres */
    const float *weight; /* (n) share of the information that a point brings */
    const float *q;      /* (n) depth / (focal x baseline); 0: no disparity offset */
} Query;

typedef struct {
    int64_t iterations;
    double reach;             /* m */
    double robust_first, robust_last; /* m, width of the robust kernel: from wide to narrow */
    double surface;           /* m, roughness of any surface */
    double prior_weight;      /* information of the priors, in points */
    double tilt, height, position, scale, offset; /* standard deviations of the priors: rad, m, m, log, px m / (f b) */
    double free_scale, free_offset; /* 0 or 1 */
} Options;

typedef struct {
    double R[9], t[3], log_scale, offset;
    double anchor[3], up[3]; /* where the priors expect the camera, and the normal of the ground there */
    double H[UNKNOWNS * UNKNOWNS];
    double inliers, seen, cost;
} State;

#define HEIGHT 60.0 /* m */
#define AHEAD 32 /* points whose memory is fetched together: one by one, most of the time would go into waiting for it */

/* Where the number of the surfel nearest to a point is kept; 0 far from every surface. */
static inline const int32_t *cell_at(const Grid *g, double x, double y, double z)
{
    /* Without floor(), a call on a plain x86-64: what is not negative may be cut off instead. */
    double scale = 1.0 / g->cell, fx = (x - g->ox) * scale, fy = (y - g->oy) * scale, fz = (z - g->oz) * scale;
    if (!(fx >= 0 && fy >= 0 && fz >= 0 && fx < 1e9 && fy < 1e9 && fz < 1e9)) return 0;
    uint32_t ix = (uint32_t)(int64_t)fx, iy = (uint32_t)(int64_t)fy, iz = (uint32_t)(int64_t)fz;
    uint32_t a = ix / BLOCK, b = iy / BLOCK, c = iz / BLOCK;
    if (a >= g->bx || b >= g->by || c >= g->bz) return 0;
    int32_t block = g->block[(a * g->by + b) * g->bz + c];
    if (block < 0) return 0;
    uint32_t inside = ((ix % BLOCK) * BLOCK + iy % BLOCK) * BLOCK + iz % BLOCK;
    return g->nearest + (int64_t)block * BLOCK_CELLS + inside;
}

/* Cholesky solution of A x = b in place; 0 where A is not positive definite. */
static int solve(double A[UNKNOWNS][UNKNOWNS], double b[UNKNOWNS])
{
    for (int j = 0; j < UNKNOWNS; j++) {
        for (int k = 0; k < j; k++)
            for (int i = j; i < UNKNOWNS; i++) A[i][j] -= A[i][k] * A[j][k];
        if (!(A[j][j] > 1e-12)) return 0;
        double d = sqrt(A[j][j]);
        for (int i = j; i < UNKNOWNS; i++) A[i][j] /= d;
    }
    for (int i = 0; i < UNKNOWNS; i++) {
        for (int k = 0; k < i; k++) b[i] -= A[i][k] * b[k];
        b[i] /= A[i][i];
    }
    for (int i = UNKNOWNS - 1; i >= 0; i--) {
        for (int k = i + 1; k < UNKNOWNS; k++) b[i] -= A[k][i] * b[k];
        b[i] /= A[i][i];
    }
    return 1;
}

static void turn_left(double R[9], const double w_in[3])
{
    double w[3] = {w_in[0], w_in[1], w_in[2]};
    double angle = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
    if (angle > 0.1) {
        for (int i = 0; i < 3; i++) w[i] *= 0.1 / angle;
        angle = 0.1;
    }
    double s = angle > 1e-9 ? sin(angle) / angle : 1.0, c = angle > 1e-9 ? (1 - cos(angle)) / (angle * angle) : 0.5;
    double K[9] = {0, -w[2], w[1], w[2], 0, -w[0], -w[1], w[0], 0}, A[9], out[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double kk = 0;
            for (int k = 0; k < 3; k++) kk += K[3 * i + k] * K[3 * k + j];
            A[3 * i + j] = (i == j) + s * K[3 * i + j] + c * kk;
        }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            out[3 * i + j] = 0;
            for (int k = 0; k < 3; k++) out[3 * i + j] += A[3 * i + k] * R[3 * k + j];
        }
    memcpy(R, out, sizeof out);
}

static inline void place(const Query *q, int64_t i, const State *s, double e_scale, double y[3], double *stretch)
{
    *stretch = e_scale / (1.0 + s->offset * q->q[i]);
    double px = *stretch * q->xyz[3 * i], py = *stretch * q->xyz[3 * i + 1], pz = *stretch * q->xyz[3 * i + 2];
    for (int k = 0; k < 3; k++) y[k] = s->R[3 * k] * px + s->R[3 * k + 1] * py + s->R[3 * k + 2] * pz;
}

/* Points first .. first + count - 1 as they stand in the map: ``y`` turned, ``w`` in the world, and their nearest surfels. */
static void look_up(const Grid *g, const Surfel *surfels, const Query *q, const State *s, double e_scale, int64_t first,
                    int64_t count, double y[][3], double w[][3], double *stretch, const Surfel **found)
{
    const int32_t *cells[AHEAD];
    for (int64_t k = 0; k < count; k++) {
        place(q, first + k, s, e_scale, y[k], stretch + k);
        for (int a = 0; a < 3; a++) w[k][a] = y[k][a] + s->t[a];
        cells[k] = cell_at(g, w[k][0], w[k][1], w[k][2]);
        if (cells[k]) __builtin_prefetch(cells[k]);
    }
    for (int64_t k = 0; k < count; k++) {
        found[k] = cells[k] && *cells[k] >= 0 ? surfels + *cells[k] : 0;
        if (found[k]) __builtin_prefetch(found[k]);
    }
}

/* The camera stands at its height above the anchor's ground, upright on it; scale and offset are small. */
static void add_priors(const Options *o, const State *s, double n, double H[UNKNOWNS][UNKNOWNS], double b[UNKNOWNS])
{
    double p = o->prior_weight * n;
    double position = p / (o->position * o->position), height = p / (o->height * o->height);
    double tilt = p / (o->tilt * o->tilt), scale = p / (o->scale * o->scale), offset = p / (o->offset * o->offset);
    double leans[3] = {s->R[2], s->R[5], s->R[8]}, away[3], above = 0;
    /* The turn that takes the query's up onto the ground's normal is their cross product. */
    double turn[3] = {leans[1] * s->up[2] - leans[2] * s->up[1], leans[2] * s->up[0] - leans[0] * s->up[2],
                      leans[0] * s->up[1] - leans[1] * s->up[0]};
    for (int k = 0; k < 3; k++) {
        away[k] = s->t[k] - s->anchor[k];
        above += away[k] * s->up[k];
    }
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            H[i][j] += (height - position) * s->up[i] * s->up[j] + (i == j) * position;
            H[3 + i][3 + j] += tilt * ((i == j) - s->up[i] * s->up[j]) + (i == j) * 1e-3 * n;
        }
        b[i] -= position * away[i] + (height - position) * above * s->up[i];
        b[3 + i] += tilt * turn[i];
    }
    H[6][6] += scale;
    b[6] -= scale * s->log_scale;
    H[7][7] += offset;
    b[7] -= offset * s->offset;
    const double free_[2] = {o->free_scale, o->free_offset};
    for (int f = 0; f < 2; f++)
        if (free_[f] == 0) {
            for (int k = 0; k < UNKNOWNS; k++) H[6 + f][k] = H[k][6 + f] = 0;
            H[6 + f][6 + f] = 1;
            b[6 + f] = 0;
        }
}

/* What one point tells: its residual's gradient, the residual r itself, its weight; 0 where no surface is within reach. */
static inline int term(const Query *q, const Options *o, const State *s, double robust, int64_t i, const double y[3],
                       const double at[3], double stretch, double e_scale, const Surfel *m, double gr[UNKNOWNS], double *r_out,
                       double *w_out)
{
    if (!m) return 0;
    double dx = at[0] - m->x, dy = at[1] - m->y, dz = at[2] - m->z;
    if (dx * dx + dy * dy + dz * dz > o->reach * o->reach) return 0;
    double r = m->nx * dx + m->ny * dy + m->nz * dz, c = 0;
    for (int k = 0; k < 3; k++)
        c += (&m->nx)[k] * (s->R[3 * k] * q->ray[3 * i] + s->R[3 * k + 1] * q->ray[3 * i + 1] + s->R[3 * k + 2] * q->ray[3 * i + 2]);
    gr[0] = m->nx, gr[1] = m->ny, gr[2] = m->nz;
    gr[3] = y[1] * m->nz - y[2] * m->ny;
    gr[4] = y[2] * m->nx - y[0] * m->nz;
    gr[5] = y[0] * m->ny - y[1] * m->nx;
    gr[6] = y[0] * m->nx + y[1] * m->ny + y[2] * m->nz;
    gr[7] = -gr[6] * q->q[i] * stretch / e_scale;
    /* A triangulating camera errs evenly in 1 / range. Its noise must be told from the range where the ray meets the surface:
     * by the measured one, what is seen too near counts as well measured and pulls everything its way. */
    double ratio = gr[6] != 0 ? 1 - r / gr[6] : 1;
    ratio = ratio < 0.5 ? 0.5 : ratio > 2 ? 2 : ratio;
    double along = q->sigma[i] * c;
    double variance = along * along * ratio * ratio * ratio + o->surface * o->surface + (double)m->thickness * m->thickness;
    double k2 = 4 * variance + robust * robust, damp = k2 / (k2 + r * r);
    *r_out = r;
    *w_out = q->weight[i] * damp * damp / variance;
    return 1;
}

static void align_one(const Grid *g, const Surfel *surfels, const Query *q, const Options *o, State *s)
{
    double known = 0;
    for (int64_t i = 0; i < q->count; i++) known += q->weight[i];
    for (int64_t it = 0; it < o->iterations; it++) {
        double share = o->iterations > 1 ? (double)it / (double)(o->iterations - 1) : 1.0;
        double robust = o->robust_first * pow(o->robust_last / o->robust_first, share);
        double H[UNKNOWNS][UNKNOWNS] = {{0}}, b[UNKNOWNS] = {0}, gr[UNKNOWNS], r, w, e_scale = exp(s->log_scale);
        double total = 0, batch_y[AHEAD][3], batch_w[AHEAD][3], batch_stretch[AHEAD];
        const Surfel *batch_found[AHEAD];
        for (int64_t i = 0; i < q->count; i++) {
            int64_t in = i % AHEAD, left = q->count - i;
            if (in == 0)
                look_up(g, surfels, q, s, e_scale, i, left < AHEAD ? left : AHEAD, batch_y, batch_w, batch_stretch, batch_found);
            if (!term(q, o, s, robust, i, batch_y[in], batch_w[in], batch_stretch[in], e_scale, batch_found[in], gr, &r, &w)) continue;
            for (int a = 0; a < UNKNOWNS; a++) {
                double wa = w * gr[a];
                b[a] -= wa * r;
                for (int d = 0; d <= a; d++) H[a][d] += wa * gr[d];
            }
            total += q->weight[i];
        }
        for (int a = 0; a < UNKNOWNS; a++)
            for (int d = 0; d < a; d++) H[d][a] = H[a][d];
        for (int a = 0; a < UNKNOWNS; a++) memcpy(s->H + a * UNKNOWNS, H[a], sizeof H[a]);
        s->seen = total;
        add_priors(o, s, known, H, b);
        if (!solve(H, b)) return;
        for (int k = 0; k < 3; k++) s->t[k] += b[k];
        turn_left(s->R, b + 3);
        s->log_scale += b[6];
        s->offset += b[7];
        double moved = b[0] * b[0] + b[1] * b[1] + b[2] * b[2], turned = b[3] * b[3] + b[4] * b[4] + b[5] * b[5];
        if (it > 3 && robust <= 1.01 * o->robust_last && moved < 1e-8 && turned < 1e-10) return;
    }
}

/* Share of the query's weight that lies on the map: weighted by how well each point is measured, softly cut. */
static void score_one(const Grid *g, const Surfel *surfels, const Query *q, double tolerance, double height_min, State *s)
{
    double inliers = 0, total = 0, e_scale = exp(s->log_scale);
    double batch_y[AHEAD][3], batch_w[AHEAD][3], batch_stretch[AHEAD];
    const Surfel *batch_found[AHEAD];
    for (int64_t i = 0; i < q->count; i++) {
        int64_t in = i % AHEAD, left = q->count - i;
        if (in == 0)
            look_up(g, surfels, q, s, e_scale, i, left < AHEAD ? left : AHEAD, batch_y, batch_w, batch_stretch, batch_found);
        double sigma = q->sigma[i];
        if (batch_y[in][2] < height_min) continue;
        double w = q->weight[i] / (1 + 4 * sigma * sigma);
        total += w;
        const Surfel *m = batch_found[in];
        if (!m) continue;
        double dx = batch_w[in][0] - m->x, dy = batch_w[in][1] - m->y, dz = batch_w[in][2] - m->z;
        if (dx * dx + dy * dy + dz * dz > 1.0 + 4 * sigma * sigma) continue;
        double r = m->nx * dx + m->ny * dy + m->nz * dz, c = 0;
        for (int k = 0; k < 3; k++)
            c += (&m->nx)[k] * (s->R[3 * k] * q->ray[3 * i] + s->R[3 * k + 1] * q->ray[3 * i + 1] + s->R[3 * k + 2] * q->ray[3 * i + 2]);
        double variance = sigma * sigma * c * c + tolerance * tolerance;
        inliers += w * exp(-0.5 * r * r / variance);
    }
    s->inliers = total > 0 ? inliers / total : 0;
    s->cost = total;
}

void streetfix_align(const Grid *g, const Surfel *surfels, const Query *q, const Options *o, double tolerance, double height_min, int64_t count, State *states)
{
    for (int64_t k = 0; k < count; k++) {
        if (o->iterations > 0) align_one(g, surfels, q, o, states + k);
        score_one(g, surfels, q, tolerance, height_min, states + k);
    }
}

/* The pull (weight times residual times gradient) of each patch of the picture at a pose, summed: (patches, 8), zero at first. */
void streetfix_pulls(const Grid *g, const Surfel *surfels, const Query *q, const Options *o, const State *s, const int32_t *patch, double *pulls)
{
    double e_scale = exp(s->log_scale), gr[UNKNOWNS], r, w;
    double batch_y[AHEAD][3], batch_w[AHEAD][3], batch_stretch[AHEAD];
    const Surfel *batch_found[AHEAD];
    for (int64_t i = 0; i < q->count; i++) {
        int64_t in = i % AHEAD, left = q->count - i;
        if (in == 0)
            look_up(g, surfels, q, s, e_scale, i, left < AHEAD ? left : AHEAD, batch_y, batch_w, batch_stretch, batch_found);
        if (!term(q, o, s, o->robust_last, i, batch_y[in], batch_w[in], batch_stretch[in], e_scale, batch_found[in], gr, &r, &w)) continue;
        for (int a = 0; a < UNKNOWNS; a++) pulls[UNKNOWNS * patch[i] + a] += w * r * gr[a];
    }
}

/* Blocks that any surfel's reach touches get marked 1 in ``mark`` (bx, by, bz). */
void streetfix_mark(const Grid *g, const Surfel *surfels, int64_t count, double reach, uint8_t *mark)
{
    double edge = g->cell * BLOCK;
    for (int64_t i = 0; i < count; i++) {
        const float *p = &surfels[i].x;
        const double o[3] = {g->ox, g->oy, g->oz};
        int64_t low[3], high[3];
        for (int k = 0; k < 3; k++) {
            low[k] = (int64_t)floor((p[k] - reach - o[k]) / edge);
            high[k] = (int64_t)floor((p[k] + reach - o[k]) / edge);
        }
        for (int64_t a = low[0]; a <= high[0]; a++)
            for (int64_t b = low[1]; b <= high[1]; b++)
                for (int64_t c = low[2]; c <= high[2]; c++) mark[(a * g->by + b) * g->bz + c] = 1;
    }
}

/* Fill ``nearest`` (all -1) and ``distance2`` (all large): for every cell within reach the surfel nearest to its centre. */
void streetfix_fill(const Grid *g, const Surfel *surfels, int64_t count, double reach, int32_t *nearest, float *distance2)
{
    const double o[3] = {g->ox, g->oy, g->oz};
    for (int64_t i = 0; i < count; i++) {
        const float *p = &surfels[i].x;
        int64_t low[3], high[3];
        for (int k = 0; k < 3; k++) {
            low[k] = (int64_t)ceil((p[k] - reach - o[k]) / g->cell - 0.5);
            high[k] = (int64_t)floor((p[k] + reach - o[k]) / g->cell - 0.5);
        }
        for (int64_t x = low[0]; x <= high[0]; x++)
            for (int64_t y = low[1]; y <= high[1]; y++)
                for (int64_t z = low[2]; z <= high[2]; z++) {
                    double dx = o[0] + (x + 0.5) * g->cell - p[0], dy = o[1] + (y + 0.5) * g->cell - p[1];
                    double dz = o[2] + (z + 0.5) * g->cell - p[2];
                    float d2 = (float)(dx * dx + dy * dy + dz * dz);
                    if (d2 > reach * reach) continue;
                    int32_t block = g->block[((x / BLOCK) * g->by + y / BLOCK) * g->bz + z / BLOCK];
                    int64_t at = (int64_t)block * BLOCK_CELLS + ((x % BLOCK) * BLOCK + y % BLOCK) * BLOCK + z % BLOCK;
                    if (d2 < distance2[at]) {
                        distance2[at] = d2;
                        nearest[at] = (int32_t)i;
                    }
                }
    }
}

/* Depth (z, metres) that a camera would see of the surfels, each a small square facing the camera; 1e9 where nothing is.
 * ``tiles`` (n, 4): centre x, y, first surfel, count; tiles beyond reach are not looked at. R and t are T_map_camera. */
void streetfix_render(const Surfel *surfels, const double *tiles, int64_t tile_count, double tile_reach, const double *R,
                      const double *t, double fx, double fy, double cx, double cy, int64_t width, int64_t height,
                      double half_size, double reach, float *depth)
{
    for (int64_t i = 0; i < width * height; i++) depth[i] = 1e9f;
    const float r[9] = {(float)R[0], (float)R[1], (float)R[2], (float)R[3], (float)R[4],
                        (float)R[5], (float)R[6], (float)R[7], (float)R[8]};
    const float tx = (float)t[0], ty = (float)t[1], tz = (float)t[2], far = (float)reach;
    const float left = (float)(-(cx + 4) / fx), right = (float)((width - cx + 4) / fx);
    const float top = (float)(-(cy + 4) / fy), bottom = (float)((height - cy + 4) / fy);
    for (int64_t n = 0; n < tile_count; n++) {
        const double *tile = tiles + 4 * n;
        double ex = tile[0] - t[0], ey = tile[1] - t[1];
        if (hypot(ex, ey) > tile_reach) continue;
        /* Tiles beside and behind the field of view; HEIGHT is how far surfaces may rise above or fall below the camera. */
        double ahead = R[2] * ex + R[5] * ey, beside = R[0] * ex + R[3] * ey;
        double half = tile_reach - reach + HEIGHT * fabs(R[8]), wide = tile_reach - reach + HEIGHT * fabs(R[6]);
        if (ahead < -half || beside - right * ahead > hypot(1, right) * fmax(half, wide) ||
            left * ahead - beside > hypot(1, left) * fmax(half, wide)) continue;
        const Surfel *m = surfels + (int64_t)tile[2], *end = m + (int64_t)tile[3];
        for (; m < end; m++) {
            float dx = m->x - tx, dy = m->y - ty, dz = m->z - tz;
            float z = r[2] * dx + r[5] * dy + r[8] * dz;
            if (z < 0.5f || z > far) continue;
            float x = r[0] * dx + r[3] * dy + r[6] * dz, y = r[1] * dx + r[4] * dy + r[7] * dz;
            if (x < left * z || x > right * z || y < top * z || y > bottom * z) continue;
            float u = (float)fx * x / z + (float)cx, v = (float)fy * y / z + (float)cy;
            float half = (float)(half_size * fx) / z;
            if (half > 4.0f) half = 4.0f;
            int64_t u0 = (int64_t)ceilf(u - half), u1 = (int64_t)floorf(u + half);
            int64_t v0 = (int64_t)ceilf(v - half), v1 = (int64_t)floorf(v + half);
            if (u0 < 0) u0 = 0;
            if (v0 < 0) v0 = 0;
            if (u1 >= width) u1 = width - 1;
            if (v1 >= height) v1 = height - 1;
            for (int64_t b = v0; b <= v1; b++)
                for (int64_t a = u0; a <= u1; a++)
                    if (z < depth[b * width + a]) depth[b * width + a] = z;
        }
    }
}
