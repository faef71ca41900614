/* Thins a depth image to blocks with the median inverse depth, and estimates the noise of the image from its rows.
 *
 * Python checks sizes and pointers. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "../layout.h"

enum { LANES = 64, MOST_SAMPLES = 64, MOST_STEPS = 1024 };

/* Writes the compare-exchange steps that sort n values; returns their number. The steps do not depend on the values, so many blocks are
 * sorted side by side. Merge exchange: Knuth, The Art of Computer Programming 3, 5.2.2, algorithm M. */
static int64_t network(int n, uint8_t steps[MOST_STEPS][2])
{
    int64_t count = 0;
    int top = 1;
    while (2 * top < n) top *= 2;
    for (int p = n > 1 ? top : 0; p > 0; p /= 2) {
        int q = top, r = 0, d = p;
        for (;;) {
            for (int i = 0; i < n - d; i++)
                if ((i & p) == r) {
                    steps[count][0] = (uint8_t)i;
                    steps[count][1] = (uint8_t)(i + d);
                    count++;
                }
            if (q == p) break;
            d = q - p;
            q /= 2;
            r = p;
        }
    }
    return count;
}

typedef struct {
    int64_t width;        /* of the depth image, px */
    int64_t size, skip;   /* edge of a block, and distance between the pixels read, px; a block has at most MOST_SAMPLES of them */
    int64_t rows, columns; /* number of blocks */
    double edge, noise, reach; /* largest relative spread of a block, noise of an inverse depth (1/m), largest depth (m) */
} Blocks;

/* service/compiled.py compares this table with Python's structures when it loads the library. */
/* clang-format off */
const LayoutEntry streetfix_layout[] = {
    LAYOUT_STRUCT(Blocks), LAYOUT_FIELD(Blocks, width), LAYOUT_FIELD(Blocks, size), LAYOUT_FIELD(Blocks, skip),
    LAYOUT_FIELD(Blocks, rows), LAYOUT_FIELD(Blocks, columns), LAYOUT_FIELD(Blocks, edge), LAYOUT_FIELD(Blocks, noise),
    LAYOUT_FIELD(Blocks, reach),
    LAYOUT_END,
};
/* clang-format on */

/* z (rows, columns): depth of each block from its median inverse depth, m; 0 if fewer than half of the pixels read are measured, on an
 * edge, or beyond the reach. */
void streetfix_blocks(const float *depth, const Blocks *b, float *z)
{
    uint8_t steps[MOST_STEPS][2];
    int samples = 0;
    for (int64_t y = 0; y < b->size; y += b->skip)
        for (int64_t x = 0; x < b->size; x += b->skip) samples++;
    const int64_t count = network(samples, steps);
    const int least_measured = samples + 1 > 2 ? (samples + 1) / 2 : 1;
    float value[MOST_SAMPLES][LANES];
    int measured[LANES];
    for (int64_t row = 0; row < b->rows; row++)
        for (int64_t first = 0; first < b->columns; first += LANES) {
            const int64_t lanes = b->columns - first < LANES ? b->columns - first : LANES;
            memset(measured, 0, sizeof measured);
            int s = 0;
            for (int64_t y = 0; y < b->size; y += b->skip)
                for (int64_t x = 0; x < b->size; x += b->skip, s++) {
                    const float *source = depth + (row * b->size + y) * b->width + first * b->size + x;
                    for (int64_t k = 0; k < lanes; k++) {
                        const float d = source[k * b->size];
                        const int valid = d > 0;
                        value[s][k] = valid ? 1.0f / d : INFINITY;
                        measured[k] += valid;
                    }
                    for (int64_t k = lanes; k < LANES; k++) value[s][k] = INFINITY;
                }
            for (int64_t i = 0; i < count; i++) {
                float *one = value[steps[i][0]], *other = value[steps[i][1]];
                for (int k = 0; k < LANES; k++) {
                    const float low = one[k] < other[k] ? one[k] : other[k], high = one[k] < other[k] ? other[k] : one[k];
                    one[k] = low;
                    other[k] = high;
                }
            }
            for (int64_t k = 0; k < lanes; k++) {
                const int n = measured[k];
                float *out = z + row * b->columns + first + k;
                *out = 0;
                if (n < least_measured) continue;
                const float low = value[(int)(0.1 * (n - 1))][k], high = value[(int)(0.9 * (n - 1))][k];
                /* For an even number of values take the mean of the middle two. The lower one alone would bias all depths upwards. */
                const float median = 0.5f * (value[(int)(0.5 * (n - 1))][k] + value[n / 2][k]);
                const float z_m = 1.0f / median;
                if ((double)(high - low) - 2.56 * b->noise < b->edge * (double)median && z_m < (float)b->reach) *out = z_m;
            }
        }
}

/* Writes the absolute second differences of the inverse depth (1/m) along every `every`-th row, of pixels `step` apart. Returns their
 * number. */
int64_t streetfix_second_differences(const float *depth, int64_t height, int64_t width, int64_t every, int64_t step, float *out)
{
    int64_t count = 0;
    for (int64_t y = 0; y < height; y += every) {
        const float *row = depth + y * width;
        for (int64_t x = 0; x + 2 * step < width; x++) {
            const float a = row[x], b = row[x + step], c = row[x + 2 * step];
            if (a > 0 && b > 0 && c > 0) out[count++] = fabsf(1.0f / a - 2.0f * (1.0f / b) + 1.0f / c);
        }
    }
    return count;
}
