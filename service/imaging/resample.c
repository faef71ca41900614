/* Resamples a depth and a colour image to the cells of a view grid. Each cell has several rays. Its range is the median over the rays
 * that hit a measurement. Its colour is the mean over the rays that hit a pixel.
 *
 * Rays are stored sample by sample: the first rays of all cells, then the second rays of all cells, and so on. So every loop over
 * cells reads contiguous memory. Python checks sizes and pointers. Pixels outside an image are never read. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "picture.h"

/* ARGUMENTS: of streetfix_resample. */
enum { SAMPLES = 9, BLOCK = 128, ARGUMENTS = 14 };

/* Compared with Python's structures when the library is loaded. */
const LayoutEntry streetfix_layout[] = {
    PICTURE_LAYOUT,
    LAYOUT_CONSTANT(SAMPLES),
    LAYOUT_CONSTANT(ARGUMENTS),
    LAYOUT_END,
};

/* Projects each ray of a block into an image: flat index of the pixel, -1 outside. Rounds half to even, like rint. */
static void project(const float *x, const float *y, const float *z, int64_t count, const Picture *p, int32_t *index)
{
    const float fx = (float)p->fx, fy = (float)p->fy, cx = (float)p->cx, cy = (float)p->cy;
    const float w = (float)p->width, h = (float)p->height;
    const float magic = 12582912.0f; /* 1.5 * 2^23: a float of this size has no fractional bits, so adding it rounds */
    const int32_t width = (int32_t)p->width;
    for (int64_t i = 0; i < count; i++) {
        const int in_front = z[i] > 1e-3f;
        const float inverse = 1.0f / (in_front ? z[i] : 1.0f);
        float u = x[i] * inverse * fx + cx, v = y[i] * inverse * fy + cy;
        u = u > -2.0f ? u : -2.0f;
        u = u < w + 2.0f ? u : w + 2.0f;
        v = v > -2.0f ? v : -2.0f;
        v = v < h + 2.0f ? v : h + 2.0f;
        u = (u + magic) - magic;
        v = (v + magic) - magic;
        const int inside = in_front & (u >= 0.0f) & (u < w) & (v >= 0.0f) & (v < h);
        index[i] = inside ? (int32_t)v * width + (int32_t)u : -1;
    }
}

static void sort_pairs(float *a, float *b, int64_t count)
{
    for (int64_t i = 0; i < count; i++) {
        const float low = a[i] < b[i] ? a[i] : b[i], high = a[i] < b[i] ? b[i] : a[i];
        a[i] = low;
        b[i] = high;
    }
}

/* Floyd's network of 25 comparators for nine (Knuth, The Art of Computer Programming 3, 5.3.4). */
static const int NETWORK[25][2] = {{0, 1}, {3, 4}, {6, 7}, {1, 2}, {4, 5}, {7, 8}, {0, 1}, {3, 4}, {6, 7}, {0, 3}, {3, 6}, {0, 3}, {1, 4},
                                   {4, 7}, {1, 4}, {2, 5}, {5, 8}, {2, 5}, {1, 3}, {5, 7}, {2, 6}, {4, 6}, {2, 4}, {2, 3}, {5, 6}};

/* rays: SAMPLES x 3 x cells, level frame of the view. R: rotation from this frame to the optical frame, row-major.
 * depth: z, metres. observed: 0 for pixels of the depth image that no sensor saw, of the size of depth; NULL: all were seen.
 * min_range, max_range: metres. fewest: rays with a measurement that a range needs.
 * Output: ranges (metres, 0 without a range) and seen have one value per cell, colour (0..255) has cells x 3 values. */
void streetfix_resample(const float *rays, int64_t cells, const double *R, const float *depth, const Picture *depth_picture,
                        const uint8_t *observed, const uint8_t *rgb, const Picture *rgb_picture, double min_range, double max_range,
                        int64_t fewest, float *ranges, float *colour, uint8_t *seen)
{
    float r[9];
    for (int k = 0; k < 9; k++) r[k] = (float)R[k];
    const int same_picture = memcmp(depth_picture, rgb_picture, sizeof(Picture)) == 0;
    const float nearest = (float)min_range, farthest = (float)max_range;
    for (int64_t first = 0; first < cells; first += BLOCK) {
        const int64_t count = cells - first < BLOCK ? cells - first : BLOCK;
        float distance[SAMPLES][BLOCK], x[BLOCK], y[BLOCK], z[BLOCK];
        int32_t depth_pixel[BLOCK], rgb_pixel[BLOCK], measured[BLOCK], coloured[BLOCK], sum[3][BLOCK];
        memset(measured, 0, sizeof measured);
        memset(coloured, 0, sizeof coloured);
        memset(sum, 0, sizeof sum);
        memset(seen + first, 0, (size_t)count);
        for (int s = 0; s < SAMPLES; s++) {
            const float *lx = rays + (int64_t)(3 * s) * cells + first, *ly = lx + cells, *lz = ly + cells;
            for (int64_t i = 0; i < count; i++) {
                x[i] = r[0] * lx[i] + r[1] * ly[i] + r[2] * lz[i];
                y[i] = r[3] * lx[i] + r[4] * ly[i] + r[5] * lz[i];
                z[i] = r[6] * lx[i] + r[7] * ly[i] + r[8] * lz[i];
            }
            project(x, y, z, count, depth_picture, depth_pixel);
            if (!same_picture) project(x, y, z, count, rgb_picture, rgb_pixel);
            if (observed)
                for (int64_t i = 0; i < count; i++)
                    if (depth_pixel[i] >= 0 && !observed[depth_pixel[i]]) depth_pixel[i] = rgb_pixel[i] = -1;
            const int32_t *colour_pixel = same_picture ? depth_pixel : rgb_pixel;
            for (int64_t i = 0; i < count; i++) {
                float range = INFINITY;
                if (depth_pixel[i] >= 0) {
                    seen[first + i] = 1;
                    /* Range from depth: the unit ray has the z component z[i]. */
                    const float d = depth[depth_pixel[i]] / z[i];
                    if (d >= nearest && d <= farthest) {
                        range = d;
                        measured[i]++;
                    }
                }
                distance[s][i] = range;
                if (colour_pixel[i] >= 0) {
                    const uint8_t *pixel = rgb + 3 * (int64_t)colour_pixel[i];
                    sum[0][i] += pixel[0];
                    sum[1][i] += pixel[1];
                    sum[2][i] += pixel[2];
                    coloured[i]++;
                }
            }
        }
        for (int k = 0; k < 25; k++) sort_pairs(distance[NETWORK[k][0]], distance[NETWORK[k][1]], count);
        for (int64_t i = 0; i < count; i++) {
            const int32_t measured_count = measured[i];
            ranges[first + i] = measured_count >= fewest && measured_count > 0 ? distance[(measured_count - 1) / 2][i] : 0.0f;
            const float divisor = (float)(coloured[i] > 0 ? coloured[i] : 1);
            for (int c = 0; c < 3; c++) colour[3 * (first + i) + c] = (float)sum[c][i] / divisor;
        }
    }
}
