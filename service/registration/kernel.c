/* Weighted, robust point-to-plane registration of a depth image on a prepared surfel map; see kernel.py.
 *
 * Unknowns, in this order: translation (3), rotation (3, left increment), log scale, disparity offset. A point p of the query is in
 * its level frame, with the camera at the origin. The corrected point is  y = s p / (1 + o q),  q = depth / (focal length x baseline).
 * Its position in the surfels' frame is R y + t. Plain C without global state, so several threads may call it at once.
 */
#include <math.h>
#include <stdint.h>
#include <string.h>

#include "surfel.h"
#include "wide.h"

#define UNKNOWNS 8
#define BLOCK 8       /* cells along the edge of a block */
#define PART 4        /* cells along the edge of a part; a block has 2 x 2 x 2 parts */
#define PARTS 8
#define PART_CELLS 64 /* one bit of a uint64_t for each */
#define REGION 8      /* blocks along the edge of a region */
#define REGION_BLOCKS (REGION * REGION * REGION)
#define REGION_WORDS (REGION_BLOCKS / 64)
#define REGION_EDGE (REGION * BLOCK) /* cells along the edge of a region */
#define KEY_BITS 18   /* bits of a region's number along each axis */
#define NUMBER_BITS 9 /* bits of a block's number in its region, and of the number of filled cells before a part */
#define OWN_BITS 8    /* bits of the number of a block's own surfels */
#define NARROW 256    /* most surfels of a narrow block: its own, and the foreign ones that its cells refer to */
#define FOREIGN_BYTES 2 /* bytes of a foreign surfel's number in a narrow block */
#define WIDE_BYTES 3  /* bytes of a cell in a wide block */

/* A block with at least one filled cell. A filled cell has a surfel in reach of its centre.
 *
 * A cell of a narrow block has one byte. If the block has n surfels, a byte below n is one of them, and a byte n + k is foreign surfel k.
 * The bytes before ``first`` list the foreign surfels backwards. A cell of a wide block has the number of its surfel in the region. */
typedef struct {
    uint64_t filled[PARTS]; /* bit (x * 4 + y) * 4 + z of a part: the cell is filled */
    uint64_t before;        /* number of filled cells before parts 1 to 7, NUMBER_BITS each; uppermost bit: the block is wide */
    uint32_t first;         /* byte of its first filled cell in cells, counted from the first byte of the region */
    uint32_t own; /* lower OWN_BITS: number of its own surfels; others: the first one, counted from that of the region. 0: wide */
} Block;

/* A region with at least one block or surfel. It numbers its surfels block by block, then those of other regions that are in
 * ``others``. */
typedef struct {
    int64_t key; /* numbers of the region along x, y, z: (x << 36) + (y << 18) + z */
    int64_t block, surfel, other; /* rows of the region's first block in blocks, surfel in surfels, and entry in others */
    int64_t cells; /* first byte of its blocks in cells */
    uint32_t surfels, others; /* number of its surfels, and of its entries in others */
    uint64_t has[REGION_WORDS]; /* bit of each block's number: it has filled cells. The rows of these blocks are ascending by number */
    uint16_t before[REGION_WORDS]; /* number of such blocks before each word of has */
} Region;

/* Surfels with their regions: a map of one bundle, or what a tile has of a tiled map. */
typedef struct {
    int64_t slot_bits; /* binary logarithm of the number of slots */
    const int32_t *slots; /* hash table with linear probing: row of a region in regions, -1 for none */
    const Region *regions;
    const Block *blocks;
    const uint8_t *cells; /* of each filled cell: the surfel nearest to its centre; see Block */
    const int32_t *others; /* rows in surfels */
    const PackedSurfel *surfels;
    const uint8_t *served; /* 1 for a region that this piece gives to the grid; 0: it gives all */
    int64_t shift[3]; /* regions along x, y, z from the corner of the grid to that of this piece */
    int64_t first; /* number of its first surfel among those of all pieces */
} Piece;

/* The regions of all pieces together. Each region comes from one piece. */
typedef struct {
    double ox, oy, oz, cell; /* corner of the grid and edge of a cell, m */
    int64_t count; /* number of pieces */
    const Piece *pieces;
} Grid;

/* Each array is padded with zeros to whole batches (BATCH_SIZE). */
typedef struct {
    int64_t count;
    const float *xyz[3]; /* level frame, m */
    const float *ray[3]; /* unit vectors from the camera, level frame */
    const float *sigma; /* standard deviation along the ray, m */
    const float *weight; /* factor of a point's information */
    const float *q; /* depth / (focal length x baseline), 1/px; 0: no disparity offset */
} Query;

typedef struct {
    int64_t iterations;
    double reach; /* largest distance between a point and its surfel, m */
    double robust_first, robust_last; /* width of the robust kernel in the first and in the last iteration, m */
    double surface; /* roughness of all surfaces, m */
    double prior_weight; /* information of the priors, as a share of the summed weight of all points */
    double tilt, height, position, scale, offset; /* standard deviations of the priors: rad, m, m, log scale, px */
    double free_scale, free_offset; /* 0 or 1 */
} Options;

typedef struct {
    double R[9], t[3], log_scale, offset;
    double anchor[3], up[3]; /* mean of the priors of position and height (surfels' frame, m); normal of the ground there */
    double information[UNKNOWNS * UNKNOWNS];
    double inliers, matched, weight;
    /* steps of the solver; 1 if its last step was small; half the weighted squared residuals before its last step */
    double iterations, converged, error;
} State;

#define SETTLED_M 1e-3 /* a pose has converged if its last step was smaller than this, m, */
#define SETTLED_RAD 1.7e-3 /* and turned it by less than this, rad (0.1 degrees) */
/* Points per batch. Their memory is prefetched together. Otherwise the kernel would mostly wait for memory (decision 0025). */
#define BATCH_SIZE 32
#define LANES 8 /* partial sums side by side; the same number on every machine, so all machines give the same answer */

/* Solves A x = b in place by Cholesky decomposition; returns 0 if A is not positive definite. */
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

/* R <- exp(w) R by Rodrigues' formula. One step rotates by at most 0.1 rad. */
static void rotate_left(double R[9], const double w_in[3])
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

/* A batch of points: their positions, surfels, gradients, residuals and weights. */
typedef struct {
    double y[3][BATCH_SIZE], at[3][BATCH_SIZE], stretch[BATCH_SIZE]; /* R y, and R y + t (surfels' frame, m); s / (1 + o q) */
    float local[3][BATCH_SIZE]; /* position in the region, steps */
    const PackedSurfel *surfel[BATCH_SIZE]; /* 0 for none */
    /* distance from the surfel (surfels' frame, m), its normal, its thickness (m); 0, 0 0 1 and 1 for none */
    float off[3][BATCH_SIZE], normal[3][BATCH_SIZE], thickness[BATCH_SIZE];
    /* gradient of the residual, residual, weight; matched: 1 if a surfel is in reach, otherwise 0 */
    double gradient[UNKNOWNS][BATCH_SIZE], r[BATCH_SIZE], w[BATCH_SIZE], matched[BATCH_SIZE];
} Batch;

/* The regions that a query has touched, so that few points search the hash table. Two regions share an entry if they are 8 regions apart. */
#define RECENT 8
typedef struct {
    int64_t key[RECENT * RECENT * RECENT];
    const Region *region[RECENT * RECENT * RECENT]; /* EMPTY_REGION if the grid has no such region */
    const Piece *piece[RECENT * RECENT * RECENT]; /* the piece that has it */
} Recent;

static inline void forget(Recent *recent)
{
    for (int i = 0; i < RECENT * RECENT * RECENT; i++) recent->key[i] = -1;
}

/* Slot at which the search for a region begins: Fibonacci hashing (Knuth, The Art of Computer Programming 3, section 6.4). */
static inline int64_t first_slot(int64_t key, int64_t slot_bits)
{
    return (int64_t)(((uint64_t)key * 0x9E3779B97F4A7C15u) >> (64 - slot_bits));
}

static const Region EMPTY_REGION;
static const Block EMPTY_BLOCK;

static inline int64_t key_of(int64_t x, int64_t y, int64_t z)
{
    return (x << 2 * KEY_BITS) + (y << KEY_BITS) + z;
}

/* Finds the region x, y, z of a piece; EMPTY_REGION if the piece does not give it to the grid. */
static inline const Region *region_of(const Piece *piece, int64_t x, int64_t y, int64_t z)
{
    const int64_t own[3] = {x - piece->shift[0], y - piece->shift[1], z - piece->shift[2]};
    if (own[0] < 0 || own[1] < 0 || own[2] < 0) return &EMPTY_REGION;
    const int64_t key = key_of(own[0], own[1], own[2]), last = ((int64_t)1 << piece->slot_bits) - 1;
    int64_t slot = first_slot(key, piece->slot_bits);
    for (int64_t tried = 0; tried <= last; tried++) {
        const int32_t row = piece->slots[slot];
        if (row < 0) return &EMPTY_REGION;
        if (piece->regions[row].key == key) return piece->served && !piece->served[row] ? &EMPTY_REGION : piece->regions + row;
        slot = (slot + 1) & last;
    }
    return &EMPTY_REGION;
}

/* Enters the region of a key in the recent ones. */
static inline void find_region(const Grid *g, int64_t key, int32_t entry, Recent *recent)
{
    const int64_t mask = ((int64_t)1 << KEY_BITS) - 1;
    recent->key[entry] = key;
    recent->region[entry] = &EMPTY_REGION;
    recent->piece[entry] = g->pieces;
    for (const Piece *piece = g->pieces; piece < g->pieces + g->count; piece++) {
        const Region *region = region_of(piece, key >> 2 * KEY_BITS, key >> KEY_BITS & mask, key & mask);
        if (region == &EMPTY_REGION) continue;
        recent->region[entry] = region;
        recent->piece[entry] = piece;
        return;
    }
}

/* Row of a block of a region, counted from its first one; -1 if the block has no filled cell. */
static inline int64_t row_of_block(const Region *region, int32_t number)
{
    const uint64_t word = region->has[number / 64], bit = (uint64_t)1 << number % 64;
    return word & bit ? region->before[number / 64] + __builtin_popcountll(word & (bit - 1)) : -1;
}

static inline int is_wide(const Block *block)
{
    return (int)(block->before >> 63);
}

/* Number of filled cells before a part. */
static inline int64_t cells_before(const Block *block, int part)
{
    return part ? (int64_t)(block->before >> NUMBER_BITS * (part - 1) & ((1 << NUMBER_BITS) - 1)) : 0;
}

/* Number of a foreign surfel of a narrow block in the region. ``cells``: its first cell; ``place``: in the list of the foreign surfels. */
static inline int64_t foreign_number(const uint8_t *cells, int64_t place)
{
    const uint8_t *at = cells - FOREIGN_BYTES * (place + 1);
    return at[0] | at[1] << 8;
}

static inline int64_t wide_number(const uint8_t *cell)
{
    return cell[0] | cell[1] << 8 | cell[2] << 16;
}

/* Row of the surfel that a filled cell of a block refers to. ``entry``: number of filled cells before it. */
static inline int64_t row_of(const Piece *piece, const Region *region, const Block *block, int64_t entry)
{
    const uint8_t *cells = piece->cells + region->cells + block->first;
    int64_t number;
    if (is_wide(block))
        number = wide_number(cells + WIDE_BYTES * entry);
    else {
        const int64_t own = block->own & ((1 << OWN_BITS) - 1);
        if (cells[entry] < own) return region->surfel + (block->own >> OWN_BITS) + cells[entry];
        number = foreign_number(cells, cells[entry] - own);
    }
    return number < region->surfels ? region->surfel + number : piece->others[region->other + number - region->surfels];
}

/* Finds the surfels that the cells at some positions refer to: ``at`` (3, BATCH_SIZE), surfels' frame, m. Writes their pieces
 * and their rows there, -1 for a cell that is not filled, and the positions in their regions, steps. */
static inline void find_cells(const Grid *g, double at[3][BATCH_SIZE], int64_t count, Recent *recent, float local[3][BATCH_SIZE],
                              const Piece **pieces, int64_t *rows)
{
    int32_t in[3][BATCH_SIZE], recent_entry[BATCH_SIZE], number[BATCH_SIZE], part[BATCH_SIZE], bit[BATCH_SIZE];
    int64_t keys[BATCH_SIZE];
    const Region *regions[BATCH_SIZE];
    const Block *blocks[BATCH_SIZE];
    int64_t cells[BATCH_SIZE];
    /* For values >= 0 truncation equals floor(), which is a slow call on plain x86-64 (decision 0025). Values outside the numbered regions
     * and NaN become -1, which is no cell. */
    const double origin[3] = {g->ox, g->oy, g->oz}, scale = 1.0 / g->cell;
    for (int a = 0; a < 3; a++)
        for (int k = 0; k < BATCH_SIZE; k++) {
            double cell = (at[a][k] - origin[a]) * scale;
            cell = cell >= 0 ? cell : -1.0;
            cell = cell < (double)(REGION_EDGE << KEY_BITS) ? cell : -1.0;
            in[a][k] = (int32_t)cell;
            local[a][k] = (float)((cell - (double)(in[a][k] & ~(REGION_EDGE - 1))) * STEPS);
        }
    for (int k = 0; k < BATCH_SIZE; k++) {
        const uint32_t outside = (uint32_t)((in[0][k] | in[1][k] | in[2][k]) >> 31);
        const uint32_t x = (uint32_t)in[0][k] | outside, y = (uint32_t)in[1][k] | outside, z = (uint32_t)in[2][k] | outside;
        const uint32_t i = x / REGION_EDGE, j = y / REGION_EDGE, l = z / REGION_EDGE;
        keys[k] = key_of(i, j, l); /* a position outside has a key that no region has */
        recent_entry[k] = (int32_t)((i % RECENT * RECENT + j % RECENT) * RECENT + l % RECENT);
        number[k] = (int32_t)((x / BLOCK % REGION * REGION + y / BLOCK % REGION) * REGION + z / BLOCK % REGION);
        part[k] = (int32_t)((x / PART % 2 * 2 + y / PART % 2) * 2 + z / PART % 2);
        bit[k] = (int32_t)((x % PART * PART + y % PART) * PART + z % PART);
    }
    /* Hardly any loop branches, because whether a cell is filled cannot be predicted. The rows of recent regions are in the cache. Blocks
     * and entries are fetched ahead. */
    for (int64_t k = 0; k < count; k++) {
        const int32_t entry = recent_entry[k];
        if (recent->key[entry] != keys[k]) find_region(g, keys[k], entry, recent);
        regions[k] = recent->region[entry];
        pieces[k] = recent->piece[entry];
    }
    for (int64_t k = 0; k < count; k++) {
        const int64_t row = row_of_block(regions[k], number[k]);
        blocks[k] = row < 0 ? &EMPTY_BLOCK : pieces[k]->blocks + regions[k]->block + row;
        __builtin_prefetch(blocks[k]->filled + part[k]);
        __builtin_prefetch(&blocks[k]->before);
    }
    for (int64_t k = 0; k < count; k++) {
        const uint64_t filled = blocks[k]->filled[part[k]], cell = (uint64_t)1 << bit[k];
        const int64_t entry = cells_before(blocks[k], part[k]) + __builtin_popcountll(filled & (cell - 1));
        __builtin_prefetch(pieces[k]->cells + regions[k]->cells + blocks[k]->first + entry); /* nearly all blocks are narrow */
        cells[k] = filled & cell ? entry : -1;
    }
    for (int64_t k = 0; k < count; k++) rows[k] = cells[k] < 0 ? -1 : row_of(pieces[k], regions[k], blocks[k], cells[k]);
}

/* Unpacks the surfels of a batch. The steps give the position modulo one region. A surfel of another region is less than half a region
 * away, so the candidate nearest to this region is the right one. */
static inline void unpack(Batch *b, double cell)
{
    static const PackedSurfel none = {{0, 0, 0}, {0, 0, 0}, 0, 0}; /* faces up */
    float packed[5][BATCH_SIZE];
    for (int k = 0; k < BATCH_SIZE; k++) {
        const PackedSurfel *m = b->surfel[k] ? b->surfel[k] : &none;
        packed[0][k] = m->xyz[0], packed[1][k] = m->xyz[1], packed[2][k] = m->xyz[2];
        int32_t pair[2];
        normal_pair(m->normal, pair);
        packed[3][k] = (float)pair[0], packed[4][k] = (float)pair[1];
        b->thickness[k] = b->surfel[k] ? unpack_thickness(m->thickness) : 1; /* avoids a variance of 0 */
        b->matched[k] = b->surfel[k] != 0;
    }
    const float step = (float)(cell / STEPS), half = CUBE_STEPS / 2;
    for (int a = 0; a < 3; a++)
        for (int k = 0; k < BATCH_SIZE; k++) {
            float off = b->local[a][k] - packed[a][k];
            off = off > half ? off - CUBE_STEPS : off;
            off = off < -half ? off + CUBE_STEPS : off;
            b->off[a][k] = off * step;
        }
    for (int k = 0; k < BATCH_SIZE; k++) { /* as unpack_normal */
        const float x = packed[3][k], y = packed[4][k], z = (float)NORMAL_STEPS - fabsf(x) - fabsf(y), fold = z < 0 ? -z : 0.0f;
        const float ux = x + (x < 0 ? fold : -fold), uy = y + (y < 0 ? fold : -fold), scale = 1.0f / sqrtf(ux * ux + uy * uy + z * z);
        b->normal[0][k] = ux * scale, b->normal[1][k] = uy * scale, b->normal[2][k] = z * scale;
    }
}

/* Positions of the points first .. first + count - 1 in the surfels' frame, and their nearest surfels. */
static inline void find_surfels(const Grid *g, const Query *q, const State *s, double e_scale, int64_t first, int64_t count, Recent *recent,
                                Batch *b)
{
    int64_t rows[BATCH_SIZE];
    const Piece *pieces[BATCH_SIZE];
    for (int k = 0; k < BATCH_SIZE; k++) b->stretch[k] = e_scale / (1.0 + s->offset * q->q[first + k]);
    for (int k = 0; k < BATCH_SIZE; k++) {
        const double px = b->stretch[k] * q->xyz[0][first + k], py = b->stretch[k] * q->xyz[1][first + k];
        const double pz = b->stretch[k] * q->xyz[2][first + k];
        for (int a = 0; a < 3; a++) {
            b->y[a][k] = s->R[3 * a] * px + s->R[3 * a + 1] * py + s->R[3 * a + 2] * pz;
            b->at[a][k] = b->y[a][k] + s->t[a];
        }
    }
    find_cells(g, b->at, count, recent, b->local, pieces, rows);
    for (int64_t k = 0; k < count; k++) {
        b->surfel[k] = rows[k] < 0 ? 0 : pieces[k]->surfels + rows[k];
        if (b->surfel[k]) __builtin_prefetch(b->surfel[k]);
    }
    for (int64_t k = count; k < BATCH_SIZE; k++) b->surfel[k] = 0;
    unpack(b, g->cell);
}

/* Adds the priors: position and height near the anchor, upright on the ground, log scale and disparity offset near 0. ``n`` is the summed
 * weight of all points. A fixed scale or offset gets a unit equation with the solution 0. */
static void add_priors(const Options *o, const State *s, double n, double H[UNKNOWNS][UNKNOWNS], double b[UNKNOWNS])
{
    double p = o->prior_weight * n;
    double position = p / (o->position * o->position), height = p / (o->height * o->height);
    double tilt = p / (o->tilt * o->tilt), scale = p / (o->scale * o->scale), offset = p / (o->offset * o->offset);
    double query_up[3] = {s->R[2], s->R[5], s->R[8]}, from_anchor[3], above_anchor = 0;
    /* To first order, this cross product is the rotation from the query's up axis to the ground's normal. */
    double tilt_error[3] = {query_up[1] * s->up[2] - query_up[2] * s->up[1], query_up[2] * s->up[0] - query_up[0] * s->up[2],
                            query_up[0] * s->up[1] - query_up[1] * s->up[0]};
    for (int k = 0; k < 3; k++) {
        from_anchor[k] = s->t[k] - s->anchor[k];
        above_anchor += from_anchor[k] * s->up[k];
    }
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            H[i][j] += (height - position) * s->up[i] * s->up[j] + (i == j) * position;
            H[3 + i][3 + j] += tilt * ((i == j) - s->up[i] * s->up[j]) + (i == j) * 1e-3 * n;
        }
        b[i] -= position * from_anchor[i] + (height - position) * above_anchor * s->up[i];
        b[3 + i] += tilt * tilt_error[i];
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

/* Computes gradients, residuals and weights of a batch. The weight is 0 if no surfel is in reach. */
static inline void linearise(const Query *q, const Options *o, const State *s, double robust, double e_scale, int64_t first, Batch *b)
{
    const float *rx = q->ray[0] + first, *ry = q->ray[1] + first, *rz = q->ray[2] + first;
    const float *sigma = q->sigma + first, *weight = q->weight + first, *depth = q->q + first;
    const double reach2 = o->reach * o->reach, surface2 = o->surface * o->surface, robust2 = robust * robust;
    for (int k = 0; k < BATCH_SIZE; k++) {
        const double dx = b->off[0][k], dy = b->off[1][k], dz = b->off[2][k];
        const double nx = b->normal[0][k], ny = b->normal[1][k], nz = b->normal[2][k], thickness = b->thickness[k];
        const double y0 = b->y[0][k], y1 = b->y[1][k], y2 = b->y[2][k];
        const double there = b->matched[k], use = dx * dx + dy * dy + dz * dz > reach2 ? 0.0 : there;
        const double r = nx * dx + ny * dy + nz * dz;
        const double c = nx * (s->R[0] * (double)rx[k] + s->R[1] * (double)ry[k] + s->R[2] * (double)rz[k]) +
                         ny * (s->R[3] * (double)rx[k] + s->R[4] * (double)ry[k] + s->R[5] * (double)rz[k]) +
                         nz * (s->R[6] * (double)rx[k] + s->R[7] * (double)ry[k] + s->R[8] * (double)rz[k]);
        const double along_y = y0 * nx + y1 * ny + y2 * nz;
        b->gradient[0][k] = nx, b->gradient[1][k] = ny, b->gradient[2][k] = nz;
        b->gradient[3][k] = y1 * nz - y2 * ny;
        b->gradient[4][k] = y2 * nx - y0 * nz;
        b->gradient[5][k] = y0 * ny - y1 * nx;
        b->gradient[6][k] = along_y;
        b->gradient[7][k] = -along_y * depth[k] * b->stretch[k] / e_scale;
        /* The error of a triangulating camera is uniform in 1 / range. So the variance is taken at the range where the ray intersects the
         * surface. At the measured range, points measured too near would count as well measured and bias the pose (decision 0036). */
        double ratio = 1 - r / (along_y != 0 ? along_y : 1);
        ratio = along_y != 0 ? ratio : 1;
        ratio = ratio < 0.5 ? 0.5 : ratio;
        ratio = ratio > 2 ? 2 : ratio;
        const double along = sigma[k] * c;
        const double variance = along * along * ratio * ratio * ratio + surface2 + thickness * thickness;
        /* The weight needs ratio^3, like the gradient in 1 / range. The robust width needs ratio^2, which is even in the error of
         * 1 / range. With ratio^3 the kernel is too slow to reject points that are measured too near (decision 0081). */
        const double even = along * along * ratio * ratio + surface2 + thickness * thickness;
        const double k2 = 4 * even + robust2, damp = k2 / (k2 + r * r);
        b->r[k] = r;
        b->w[k] = use * weight[k] * damp * damp / variance;
        b->matched[k] = use;
    }
}

static inline void add_products(const double *one, const double *other, double *sums)
{
    double own[LANES] = {0};
    for (int k = 0; k < BATCH_SIZE; k += LANES)
        for (int l = 0; l < LANES; l++) own[l] += one[k + l] * other[k + l];
    for (int l = 0; l < LANES; l++) sums[l] += own[l];
}

static inline void align_one(const Grid *g, const Query *q, const Options *o, Recent *recent, State *s)
{
    Batch batch;
    double total_weight = 0;
    for (int64_t i = 0; i < q->count; i++) total_weight += q->weight[i];
    s->iterations = s->converged = 0;
    for (int64_t it = 0; it < o->iterations; it++) {
        double share = o->iterations > 1 ? (double)it / (double)(o->iterations - 1) : 1.0;
        double robust = o->robust_first * pow(o->robust_last / o->robust_first, share);
        double sums[UNKNOWNS][UNKNOWNS + 1][LANES] = {{{0}}}, e_scale = exp(s->log_scale), total = 0, squares = 0;
        for (int64_t first = 0; first < q->count; first += BATCH_SIZE) {
            const int64_t left = q->count - first, count = left < BATCH_SIZE ? left : BATCH_SIZE;
            find_surfels(g, q, s, e_scale, first, count, recent, &batch);
            linearise(q, o, s, robust, e_scale, first, &batch);
            for (int a = 0; a < UNKNOWNS; a++) {
                double weighted[BATCH_SIZE];
                for (int k = 0; k < BATCH_SIZE; k++) weighted[k] = batch.w[k] * batch.gradient[a][k];
                for (int d = 0; d <= a; d++) add_products(weighted, batch.gradient[d], sums[a][d]);
                add_products(weighted, batch.r, sums[a][UNKNOWNS]);
            }
            for (int64_t k = 0; k < count; k++) total += batch.matched[k] * q->weight[first + k];
            for (int64_t k = 0; k < count; k++) squares += batch.w[k] * batch.r[k] * batch.r[k];
        }
        double H[UNKNOWNS][UNKNOWNS], b[UNKNOWNS];
        for (int a = 0; a < UNKNOWNS; a++) {
            for (int d = 0; d <= a; d++) {
                H[a][d] = 0;
                for (int l = 0; l < LANES; l++) H[a][d] += sums[a][d][l];
                H[d][a] = H[a][d];
            }
            b[a] = 0;
            for (int l = 0; l < LANES; l++) b[a] -= sums[a][UNKNOWNS][l];
        }
        for (int a = 0; a < UNKNOWNS; a++) memcpy(s->information + a * UNKNOWNS, H[a], sizeof H[a]);
        s->matched = total;
        s->error = 0.5 * squares;
        add_priors(o, s, total_weight, H, b);
        if (!solve(H, b)) return;
        for (int k = 0; k < 3; k++) s->t[k] += b[k];
        rotate_left(s->R, b + 3);
        s->log_scale += b[6];
        s->offset += b[7];
        s->iterations = (double)(it + 1);
        double moved = b[0] * b[0] + b[1] * b[1] + b[2] * b[2], turned = b[3] * b[3] + b[4] * b[4] + b[5] * b[5];
        s->converged = moved < SETTLED_M * SETTLED_M && turned < SETTLED_RAD * SETTLED_RAD;
        if (it > 3 && robust <= 1.01 * o->robust_last && moved < 1e-8 && turned < 1e-10) return;
    }
}

/* Share of the points on the map. Precise points weigh more. A point counts by exp(-r^2 / (2 variance)) of its distance r to the surface,
 * not by a hard threshold. */
static inline void score_one(const Grid *g, const Query *q, double tolerance, double height_min, Recent *recent, State *s)
{
    Batch batch;
    double inliers = 0, total = 0, e_scale = exp(s->log_scale);
    for (int64_t first = 0; first < q->count; first += BATCH_SIZE) {
        const int64_t left = q->count - first, count = left < BATCH_SIZE ? left : BATCH_SIZE;
        find_surfels(g, q, s, e_scale, first, count, recent, &batch);
        for (int64_t k = 0; k < count; k++) {
            const int64_t i = first + k;
            double sigma = q->sigma[i];
            if (batch.y[2][k] < height_min) continue;
            double w = q->weight[i] / (1 + 4 * sigma * sigma);
            total += w;
            if (!batch.surfel[k]) continue;
            double dx = batch.off[0][k], dy = batch.off[1][k], dz = batch.off[2][k];
            if (dx * dx + dy * dy + dz * dz > 1.0 + 4 * sigma * sigma) continue;
            double r = batch.normal[0][k] * dx + batch.normal[1][k] * dy + batch.normal[2][k] * dz, c = 0;
            for (int a = 0; a < 3; a++)
                c += batch.normal[a][k] * (s->R[3 * a] * q->ray[0][i] + s->R[3 * a + 1] * q->ray[1][i] + s->R[3 * a + 2] * q->ray[2][i]);
            double variance = sigma * sigma * c * c + tolerance * tolerance;
            inliers += w * exp(-0.5 * r * r / variance);
        }
    }
    s->inliers = total > 0 ? inliers / total : 0;
    s->weight = total;
}

/* tolerance: 0: the results are not scored. */
WIDE void streetfix_align(const Grid *g, const Query *q, const Options *o, double tolerance, double height_min, int64_t count,
                          State *states)
{
    Recent recent;
    forget(&recent);
    for (int64_t k = 0; k < count; k++) {
        if (o->iterations > 0) align_one(g, q, o, &recent, states + k);
        if (tolerance > 0) score_one(g, q, tolerance, height_min, &recent, states + k);
    }
}

/* Adds weight x residual x gradient of all points of each patch to ``gradients`` (patches, 8), which the caller sets to 0. */
void streetfix_gradients(const Grid *g, const Query *q, const Options *o, const State *s, const int32_t *patch, double *gradients)
{
    Batch batch;
    Recent recent;
    forget(&recent);
    const double e_scale = exp(s->log_scale);
    for (int64_t first = 0; first < q->count; first += BATCH_SIZE) {
        const int64_t left = q->count - first, count = left < BATCH_SIZE ? left : BATCH_SIZE;
        find_surfels(g, q, s, e_scale, first, count, &recent, &batch);
        linearise(q, o, s, o->robust_last, e_scale, first, &batch);
        for (int64_t k = 0; k < count; k++)
            for (int a = 0; a < UNKNOWNS; a++) gradients[UNKNOWNS * patch[first + k] + a] += batch.w[k] * batch.r[k] * batch.gradient[a][k];
    }
}

/* Writes to ``found`` the number of the surfel that the grid holds for each position (count, 3), surfels' frame, m; -1 for none. */
WIDE void streetfix_lookup(const Grid *g, const double *positions, int64_t count, int32_t *found)
{
    Recent recent;
    forget(&recent);
    for (int64_t first = 0; first < count; first += BATCH_SIZE) {
        const int64_t left = count - first, some = left < BATCH_SIZE ? left : BATCH_SIZE;
        double at[3][BATCH_SIZE] = {{0}};
        float local[3][BATCH_SIZE];
        int64_t rows[BATCH_SIZE];
        const Piece *pieces[BATCH_SIZE];
        for (int64_t k = 0; k < some; k++)
            for (int a = 0; a < 3; a++) at[a][k] = positions[3 * (first + k) + a];
        find_cells(g, at, some, &recent, local, pieces, rows);
        for (int64_t k = 0; k < some; k++) found[first + k] = rows[k] < 0 ? -1 : (int32_t)(pieces[k]->first + rows[k]);
    }
}

/* Cells along z that a processor compares with a surfel at once. */
#define TOGETHER 8

/* Enters a surfel in the cells of a region whose centres are in its reach and not nearer to an earlier surfel. ``low``, ``high``: the first
 * and the last cell along each axis. ``away2`` (3, REGION_EDGE): squared distance of each of these cells' centres from the surfel, m2.
 * ``reach2``: squared reach, m2. */
static inline void enter(int32_t surfel, const int64_t *low, const int64_t *high, double away2[3][REGION_EDGE], double reach2,
                         int32_t *surfel_of, float *distance2)
{
    if (low[2] > high[2]) return;
    const int64_t cells = (high[2] - low[2] + TOGETHER) / TOGETHER * TOGETHER; /* whole groups, which stay in the region */
    const int64_t first = low[2] < REGION_EDGE - cells ? low[2] : REGION_EDGE - cells;
    double of_z[REGION_EDGE];
    for (int64_t k = 0; k < cells; k++) of_z[k] = first + k >= low[2] && first + k <= high[2] ? away2[2][first + k] : INFINITY;
    for (int64_t x = low[0]; x <= high[0]; x++)
        for (int64_t y = low[1]; y <= high[1]; y++) {
            const double of_xy = away2[0][x] + away2[1][y];
            if (of_xy > reach2 * 1.000001) continue; /* more than rounding beyond the reach */
            float *d2 = distance2 + (x * REGION_EDGE + y) * REGION_EDGE + first;
            int32_t *of = surfel_of + (x * REGION_EDGE + y) * REGION_EDGE + first;
            for (int64_t k = 0; k < cells; k++) {
                const float own = (float)(of_xy + of_z[k]), other = d2[k];
                d2[k] = own < other ? own : other;
                of[k] = own < other ? surfel : of[k];
            }
        }
}

/* Builds one region: its key is set, and ``has`` is 0. ``xyz`` (n, 3): positions of all surfels, surfels' frame, m. ``which`` (count): rows
 * of the surfels whose reach may touch the region, ascending. Work memory for all cells of the region: ``surfel_of`` and ``distance2``.
 * Writes to the region which blocks have filled cells, these blocks to ``blocks``, and the surfels of their filled cells to ``nearest``. The
 * field ``first`` of a block counts from the start of ``nearest``, until streetfix_pack_cells. Returns the number of blocks. */
WIDE int64_t streetfix_build_region(const Grid *g, const float *xyz, const int32_t *which, int64_t count, double reach, int32_t *surfel_of,
                                    float *distance2, Region *region, Block *blocks, int32_t *nearest)
{
    const double o[3] = {g->ox, g->oy, g->oz}, reach2 = reach * reach;
    const int64_t mask = ((int64_t)1 << KEY_BITS) - 1;
    const int64_t corner[3] = {REGION_EDGE * (region->key >> 2 * KEY_BITS), REGION_EDGE * (region->key >> KEY_BITS & mask),
                               REGION_EDGE * (region->key & mask)};
    /* A distance is in reach if it is less than ``beyond``, the least number above the reach. */
    float beyond = (float)reach2;
    if (beyond <= reach2) beyond = nextafterf(beyond, INFINITY);
    for (int64_t i = 0; i < REGION_EDGE * REGION_EDGE * REGION_EDGE; i++) surfel_of[i] = -1, distance2[i] = beyond;
    double away2[3][REGION_EDGE];
    for (int64_t i = 0; i < count; i++) {
        const float *p = xyz + 3 * (int64_t)which[i];
        int64_t low[3], high[3];
        for (int k = 0; k < 3; k++) {
            low[k] = (int64_t)ceil((p[k] - reach - o[k]) / g->cell - 0.5) - corner[k];
            high[k] = (int64_t)floor((p[k] + reach - o[k]) / g->cell - 0.5) - corner[k];
            low[k] = low[k] > 0 ? low[k] : 0;
            high[k] = high[k] < REGION_EDGE - 1 ? high[k] : REGION_EDGE - 1;
            for (int64_t cell = low[k]; cell <= high[k]; cell++) {
                const double away = o[k] + ((double)(corner[k] + cell) + 0.5) * g->cell - p[k];
                away2[k][cell] = away * away;
            }
        }
        enter(which[i], low, high, away2, reach2, surfel_of, distance2);
    }
    int64_t found = 0, cells = 0;
    for (int64_t number = 0; number < REGION_BLOCKS; number++) {
        const int64_t i = number / (REGION * REGION), j = number / REGION % REGION, l = number % REGION;
        Block block = {.first = (uint32_t)cells};
        for (int part = 0; part < PARTS; part++) {
            if (part) block.before |= (uint64_t)(cells - block.first) << NUMBER_BITS * (part - 1);
            for (int cell = 0; cell < PART_CELLS; cell++) {
                const int64_t x = i * BLOCK + part / 4 * PART + cell / (PART * PART);
                const int64_t y = j * BLOCK + part / 2 % 2 * PART + cell / PART % PART, z = l * BLOCK + part % 2 * PART + cell % PART;
                const int32_t surfel = surfel_of[(x * REGION_EDGE + y) * REGION_EDGE + z];
                if (surfel < 0) continue;
                block.filled[part] |= (uint64_t)1 << cell;
                nearest[cells++] = surfel;
            }
        }
        if (number % 64 == 0) region->before[number / 64] = (uint16_t)found;
        if (cells == block.first) continue;
        region->has[number / 64] |= (uint64_t)1 << number % 64;
        blocks[found++] = block;
    }
    return found;
}

/* Writes the cells of a region, and completes its blocks: ``first``, ``own``, and which are wide. ``numbers``: of the surfel of each filled
 * cell, as the region numbers them, block by block. ``starts`` (REGION_BLOCKS + 1): number of the first surfel of each block. ``place``: work
 * memory for each number, -1 before and after. Needs up to WIDE_BYTES for each cell in ``cells``, and FOREIGN_BYTES * NARROW for each block.
 * Returns the number of bytes. */
int64_t streetfix_pack_cells(const Region *region, Block *blocks, const uint32_t *starts, const uint32_t *numbers, int32_t *place,
                             uint8_t *cells)
{
    int64_t size = 0;
    for (int32_t block_number = 0; block_number < REGION_BLOCKS; block_number++) {
        const int64_t row = row_of_block(region, block_number);
        if (row < 0) continue;
        Block *block = blocks + row;
        const uint32_t *of_cell = numbers + block->first, start = starts[block_number], own = starts[block_number + 1] - start;
        const int64_t filled = cells_before(block, PARTS - 1) + __builtin_popcountll(block->filled[PARTS - 1]);
        uint32_t foreign[PARTS * PART_CELLS];
        int64_t count = 0;
        int wide = own >> OWN_BITS != 0;
        for (int64_t k = 0; k < filled; k++) {
            if (of_cell[k] - start < own || place[of_cell[k]] >= 0) continue; /* unsigned: less than ``start`` is large */
            wide |= of_cell[k] >> 8 * FOREIGN_BYTES != 0;
            place[of_cell[k]] = (int32_t)count;
            foreign[count++] = of_cell[k];
        }
        wide |= own + count > NARROW;
        if (!wide) {
            for (int64_t k = count - 1; k >= 0; k--, size += FOREIGN_BYTES)
                cells[size] = (uint8_t)foreign[k], cells[size + 1] = (uint8_t)(foreign[k] >> 8);
            block->own = own ? start << OWN_BITS | own : 0;
        } else {
            block->before |= (uint64_t)1 << 63;
            block->own = 0;
        }
        block->first = (uint32_t)size;
        for (int64_t k = 0; k < filled; k++) {
            const uint32_t number = of_cell[k];
            if (wide) {
                for (int byte = 0; byte < WIDE_BYTES; byte++) cells[size++] = (uint8_t)(number >> 8 * byte);
            } else
                cells[size++] = (uint8_t)(number - start < own ? number - start : own + (uint32_t)place[number]);
        }
        for (int64_t k = 0; k < count; k++) place[foreign[k]] = -1;
    }
    return size;
}

/* What is wrong with the blocks of a grid (streetfix_check_cells); kernel.py has the texts. */
enum { SOUND, FILLED_WRONG, FIRST_WRONG, REGION_WRONG, SIZE_WRONG, SURFELS_OUTSIDE, CELL_OUTSIDE };

/* Checks a block whose bytes begin at ``cells`` + ``at``, of ``size``. Writes where they end. */
static inline int64_t check_block(const Region *region, const Block *block, const uint8_t *cells, int64_t at, int64_t size, int64_t *end)
{
    int64_t filled = 0;
    for (int part = 0; part < PARTS; part++) {
        if (cells_before(block, part) != filled) return FILLED_WRONG;
        filled += __builtin_popcountll(block->filled[part]);
    }
    if (!filled) return FILLED_WRONG;
    const int64_t first = region->cells + block->first, list = first - at, width = is_wide(block) ? WIDE_BYTES : 1;
    if (list < 0 || list % FOREIGN_BYTES || (is_wide(block) && list) || first > size) return FIRST_WRONG;
    if (size - first < filled * width) return SIZE_WRONG;
    const int64_t own = block->own & ((1 << OWN_BITS) - 1), foreign = list / FOREIGN_BYTES, start = block->own >> OWN_BITS;
    if (start + own > region->surfels) return SURFELS_OUTSIDE;
    const int64_t numbered = (int64_t)region->surfels + region->others;
    for (int64_t k = 0; k < foreign; k++)
        if (foreign_number(cells + first, k) >= numbered) return CELL_OUTSIDE;
    for (int64_t k = 0; k < filled; k++)
        if (is_wide(block) ? wide_number(cells + first + WIDE_BYTES * k) >= numbered : cells[first + k] >= own + foreign)
            return CELL_OUTSIDE;
    *end = first + filled * width;
    return SOUND;
}

/* Checks that the blocks of all regions share out ``cells`` (size), and that all cells refer to surfels that their regions number. The
 * caller has checked that the regions share out ``blocks``. */
WIDE int64_t streetfix_check_cells(const Region *regions, int64_t count, const Block *blocks, const uint8_t *cells, int64_t size)
{
    int64_t at = 0;
    for (const Region *region = regions; region < regions + count; region++) {
        if (region->cells != at) return REGION_WRONG;
        int64_t rows = 0;
        for (int word = 0; word < REGION_WORDS; word++) rows += __builtin_popcountll(region->has[word]);
        for (int64_t row = 0; row < rows; row++) {
            const int64_t found = check_block(region, blocks + region->block + row, cells, at, size, &at);
            if (found != SOUND) return found;
        }
    }
    return at == size ? SOUND : SIZE_WRONG;
}

/* Position of a surfel from the corner of the grid, in steps. */
static inline int64_t steps_of(const Grid *g, const Surfel *surfel, int axis)
{
    const double origin[3] = {g->ox, g->oy, g->oz};
    return llround((surfel->xyz[axis] - origin[axis]) / g->cell * STEPS);
}

/* Writes the key of the region that each surfel belongs to, and the number of its block: NUMBER_BITS below the key. */
void streetfix_keys(const Grid *g, const Surfel *surfels, int64_t count, int64_t *keys)
{
    for (int64_t i = 0; i < count; i++) {
        int64_t region[3], block = 0;
        for (int a = 0; a < 3; a++) {
            const int64_t steps = steps_of(g, surfels + i, a);
            region[a] = steps / CUBE_STEPS;
            block = block * REGION + steps / (BLOCK * STEPS) % REGION;
        }
        keys[i] = (key_of(region[0], region[1], region[2]) << NUMBER_BITS) + block;
    }
}

static inline double clamped(double value, double most)
{
    return value < most ? value : most;
}

/* Packs the surfels ``rows`` (count). */
void streetfix_pack(const Grid *g, const Surfel *surfels, const int64_t *rows, int64_t count, PackedSurfel *packed)
{
    for (int64_t i = 0; i < count; i++) {
        const Surfel *m = surfels + rows[i];
        for (int a = 0; a < 3; a++) packed[i].xyz[a] = (uint16_t)(steps_of(g, m, a) % CUBE_STEPS);
        const double norm = fabs((double)m->normal[0]) + fabs((double)m->normal[1]) + fabs((double)m->normal[2]);
        double x = norm > 0 ? m->normal[0] / norm : 0, y = norm > 0 ? m->normal[1] / norm : 0;
        if (m->normal[2] < 0) {
            const double folded = (1 - fabs(y)) * (x < 0 ? -1 : 1);
            y = (1 - fabs(x)) * (y < 0 ? -1 : 1), x = folded;
        }
        const uint32_t low = (uint32_t)lround(x * NORMAL_STEPS) & ((1 << NORMAL_BITS) - 1);
        const uint32_t bits = low | (uint32_t)lround(y * NORMAL_STEPS) << NORMAL_BITS;
        for (int byte = 0; byte < 3; byte++) packed[i].normal[byte] = (uint8_t)(bits >> 8 * byte);
        packed[i].thickness = (uint8_t)clamped(round(sqrt(m->thickness_m > 0 ? (double)m->thickness_m / THICKNESS_M : 0)), UINT8_MAX);
        packed[i].points = m->points ? (uint8_t)clamped(1 + round(log((double)m->points) / POINTS_LOG), UINT8_MAX) : 0;
    }
}

/* Unpacks the surfels ``rows`` (count), in any order. ``cubes`` has all surfels of the map. */
void streetfix_unpack(double cell, const Cube *cubes, int64_t cube_count, const PackedSurfel *packed, const int64_t *rows, int64_t count,
                      Surfel *surfels)
{
    const Cube *cube = cubes;
    uint32_t points[UINT8_MAX + 1] = {0};
    for (int code = 1; code <= UINT8_MAX; code++) points[code] = (uint32_t)clamped(round(exp((code - 1) * POINTS_LOG)), UINT32_MAX);
    for (int64_t i = 0; i < count; i++) {
        const PackedSurfel *m = packed + rows[i];
        if (rows[i] < cube->first || rows[i] >= cube->first + cube->count) {
            int64_t low = 0, high = cube_count; /* the last cube that begins at or before the row is in low .. high - 1 */
            while (high - low > 1) {
                const int64_t middle = (low + high) / 2;
                if (cubes[middle].first <= rows[i])
                    low = middle;
                else
                    high = middle;
            }
            cube = cubes + low;
        }
        for (int a = 0; a < 3; a++) surfels[i].xyz[a] = (float)(cube->corner[a] + cell / STEPS * m->xyz[a]);
        unpack_normal(m->normal, surfels[i].normal);
        surfels[i].thickness_m = unpack_thickness(m->thickness);
        surfels[i].points = points[m->points];
    }
}

/* Fills the hash table: ``slots`` (2 to the power of ``slot_bits``) for ``count`` regions. The caller sets it to -1, and it has more slots
 * than regions. */
void streetfix_fill_slots(const Region *regions, int64_t count, int64_t slot_bits, int32_t *slots)
{
    const int64_t last = ((int64_t)1 << slot_bits) - 1;
    for (int64_t row = 0; row < count; row++) {
        int64_t slot = first_slot(regions[row].key, slot_bits);
        while (slots[slot] >= 0) slot = (slot + 1) & last;
        slots[slot] = (int32_t)row;
    }
}

/* Renders the surfels, each a small square that faces the camera, into ``depth`` (z, m), which has larger values where nothing is nearer.
 * ``cell``: edge of a cell, m. Cubes out of reach or outside the field of view are skipped. R and t are T_map_camera. */
void streetfix_render(const PackedSurfel *surfels, const Cube *cubes, int64_t cube_count, double cell, const double *R, const double *t,
                      double fx, double fy, double cx, double cy, int64_t width, int64_t height, double half_size, double reach,
                      float *depth)
{
    const float r[9] = {(float)R[0], (float)R[1], (float)R[2], (float)R[3], (float)R[4],
                        (float)R[5], (float)R[6], (float)R[7], (float)R[8]};
    const float far = (float)reach, step = (float)(cell / STEPS);
    const float left = (float)(-(cx + 4) / fx), right = (float)((width - cx + 4) / fx);
    const float top = (float)(-(cy + 4) / fy), bottom = (float)((height - cy + 4) / fy);
    const double half_edge = 0.5 * REGION_EDGE * cell, radius = sqrt(3.0) * half_edge;
    for (int64_t n = 0; n < cube_count; n++) {
        const Cube *cube = cubes + n;
        double e[3];
        for (int a = 0; a < 3; a++) e[a] = cube->corner[a] + half_edge - t[a];
        /* Skip cubes beyond the reach, which limits the depth, and those beside and behind the field of view. */
        const double ahead = R[2] * e[0] + R[5] * e[1] + R[8] * e[2], beside = R[0] * e[0] + R[3] * e[1] + R[6] * e[2];
        if (ahead > reach + radius || ahead < -radius || beside - right * ahead > hypot(1, right) * radius ||
            left * ahead - beside > hypot(1, left) * radius)
            continue;
        const float tx = (float)(t[0] - cube->corner[0]), ty = (float)(t[1] - cube->corner[1]), tz = (float)(t[2] - cube->corner[2]);
        const PackedSurfel *m = surfels + cube->first, *end = m + cube->count;
        for (; m < end; m++) {
            float dx = step * m->xyz[0] - tx, dy = step * m->xyz[1] - ty, dz = step * m->xyz[2] - tz;
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

typedef struct {
    double hit, new, removed, outlier; /* weights of the beam model's components */
    double roughness_m, span_m; /* roughness of surfaces; length over which removed and outlier are uniform */
    double threshold_sigmas, margin_m; /* a point is off the surface beyond threshold_sigmas x sigma + margin_m */
    double unmapped_m; /* depth assumed for an empty pixel */
    double scale, offset; /* registered with the pose */
} Beam;

/* Compares measured depths with a rendered depth image. at: index of each point's pixel; z, sigma: depth along the optical axis and its
 * standard deviation; q: as in Query. out: sum of the logarithms of the density, then the numbers of points behind the map's surfaces,
 * in front of them, and where nothing is mapped. Surfaces are those of the 3 x 3 pixels around a point's own. */
void streetfix_consistency(const float *rendered, int64_t height, int64_t width, int64_t count, const int32_t *at, const double *z,
                           const double *sigma, const float *q, const Beam *o, double *out)
{
    double likelihood = 0, through = 0, front = 0, unmapped = 0;
    for (int64_t i = 0; i < count; i++) {
        const int64_t row = at[i] / width, column = at[i] % width;
        const int64_t top = row > 0 ? row - 1 : 0, bottom = row + 1 < height ? row + 1 : row;
        const int64_t left = column > 0 ? column - 1 : 0, right = column + 1 < width ? column + 1 : column;
        float nearest = INFINITY, farthest = 0;
        for (int64_t v = top; v <= bottom; v++)
            for (int64_t u = left; u <= right; u++) {
                const float d = rendered[v * width + u] > 0 ? rendered[v * width + u] : (float)o->unmapped_m;
                nearest = d < nearest ? d : nearest;
                farthest = d > farthest ? d : farthest;
            }
        const double mapped = rendered[at[i]] > 0 ? (double)rendered[at[i]] : o->unmapped_m;
        const double corrected = z[i] * o->scale / (1.0 + o->offset * q[i]),
                     sigma_total = sqrt(sigma[i] * sigma[i] + o->roughness_m * o->roughness_m);
        const double deviation = (corrected - mapped) / sigma_total,
                     hit = exp(-0.5 * deviation * deviation) / (2.5066282746310002 * sigma_total);
        const double new_object = corrected < mapped ? o->new / (mapped > 2.0 ? mapped : 2.0) : 0.0;
        likelihood += log(o->hit * hit + new_object + ((corrected > mapped ? o->removed : 0.0) + o->outlier) / o->span_m);
        const double threshold = o->threshold_sigmas * sigma[i] + o->margin_m;
        if (nearest >= (float)o->unmapped_m)
            unmapped++;
        else if (corrected > (double)farthest + threshold)
            through++;
        else if (corrected < (double)nearest - threshold)
            front++;
    }
    out[0] = likelihood;
    out[1] = through;
    out[2] = front;
    out[3] = unmapped;
}

/* service/compiled.py compares this table with Python's structures when it loads the library. */
/* clang-format off */
const LayoutEntry streetfix_layout[] = {
    SURFEL_LAYOUT,
    LAYOUT_STRUCT(Block), LAYOUT_FIELD(Block, filled), LAYOUT_FIELD(Block, before), LAYOUT_FIELD(Block, first),
    LAYOUT_FIELD(Block, own),
    LAYOUT_STRUCT(Region), LAYOUT_FIELD(Region, key), LAYOUT_FIELD(Region, block), LAYOUT_FIELD(Region, surfel),
    LAYOUT_FIELD(Region, other), LAYOUT_FIELD(Region, cells), LAYOUT_FIELD(Region, surfels), LAYOUT_FIELD(Region, others),
    LAYOUT_FIELD(Region, has), LAYOUT_FIELD(Region, before),
    LAYOUT_STRUCT(Piece), LAYOUT_FIELD(Piece, slot_bits), LAYOUT_FIELD(Piece, slots), LAYOUT_FIELD(Piece, regions),
    LAYOUT_FIELD(Piece, blocks), LAYOUT_FIELD(Piece, cells), LAYOUT_FIELD(Piece, others), LAYOUT_FIELD(Piece, surfels),
    LAYOUT_FIELD(Piece, served), LAYOUT_FIELD(Piece, shift), LAYOUT_FIELD(Piece, first),
    LAYOUT_STRUCT(Grid), LAYOUT_FIELD(Grid, ox), LAYOUT_FIELD(Grid, oy), LAYOUT_FIELD(Grid, oz),
    LAYOUT_FIELD(Grid, cell), LAYOUT_FIELD(Grid, count), LAYOUT_FIELD(Grid, pieces),
    LAYOUT_STRUCT(Query), LAYOUT_FIELD(Query, count), LAYOUT_FIELD(Query, xyz), LAYOUT_FIELD(Query, ray),
    LAYOUT_FIELD(Query, sigma), LAYOUT_FIELD(Query, weight), LAYOUT_FIELD(Query, q),
    LAYOUT_STRUCT(Options), LAYOUT_FIELD(Options, iterations), LAYOUT_FIELD(Options, reach),
    LAYOUT_FIELD(Options, robust_first), LAYOUT_FIELD(Options, robust_last), LAYOUT_FIELD(Options, surface),
    LAYOUT_FIELD(Options, prior_weight), LAYOUT_FIELD(Options, tilt), LAYOUT_FIELD(Options, height),
    LAYOUT_FIELD(Options, position), LAYOUT_FIELD(Options, scale), LAYOUT_FIELD(Options, offset),
    LAYOUT_FIELD(Options, free_scale), LAYOUT_FIELD(Options, free_offset),
    LAYOUT_STRUCT(State), LAYOUT_FIELD(State, R), LAYOUT_FIELD(State, t), LAYOUT_FIELD(State, log_scale),
    LAYOUT_FIELD(State, offset), LAYOUT_FIELD(State, anchor), LAYOUT_FIELD(State, up),
    LAYOUT_FIELD(State, information), LAYOUT_FIELD(State, inliers), LAYOUT_FIELD(State, matched),
    LAYOUT_FIELD(State, weight), LAYOUT_FIELD(State, iterations), LAYOUT_FIELD(State, converged), LAYOUT_FIELD(State, error),
    LAYOUT_STRUCT(Beam), LAYOUT_FIELD(Beam, hit), LAYOUT_FIELD(Beam, new), LAYOUT_FIELD(Beam, removed),
    LAYOUT_FIELD(Beam, outlier), LAYOUT_FIELD(Beam, roughness_m), LAYOUT_FIELD(Beam, span_m), LAYOUT_FIELD(Beam, threshold_sigmas),
    LAYOUT_FIELD(Beam, margin_m), LAYOUT_FIELD(Beam, unmapped_m), LAYOUT_FIELD(Beam, scale), LAYOUT_FIELD(Beam, offset),
    LAYOUT_CONSTANT(UNKNOWNS), LAYOUT_CONSTANT(BLOCK), LAYOUT_CONSTANT(KEY_BITS), LAYOUT_CONSTANT(NUMBER_BITS),
    LAYOUT_CONSTANT(REGION), LAYOUT_CONSTANT(STEPS), LAYOUT_CONSTANT(BATCH_SIZE),
    LAYOUT_END,
};
/* clang-format on */
