/* Fills the gaps of a panorama, and cuts views with the encoder's input planes out of it; see view_grid.py, which states the formulas.
 *
 * Speed: decision 0197. Plain C without global state. Python checks sizes. */
#include <math.h>
#include <stdint.h>

#include "../layout.h"
#include "../registration/wide.h"

/* Planes of a view, and the numbers of those that are written here. The last ones: numbers of arguments of the functions. */
enum { PLANES = 6, RANGE = 0, HEIGHT = 3, BRIGHTNESS = 5, GAPS = 3, FILL_ARGUMENTS = 3, CUT_ARGUMENTS = 13, BRIGHTEN_ARGUMENTS = 11 };

/* Compared with Python's constants when the library is loaded. */
const LayoutEntry streetfix_layout[] = {
    LAYOUT_CONSTANT(PLANES),
    LAYOUT_CONSTANT(RANGE),
    LAYOUT_CONSTANT(HEIGHT),
    LAYOUT_CONSTANT(BRIGHTNESS),
    LAYOUT_CONSTANT(FILL_ARGUMENTS),
    LAYOUT_CONSTANT(CUT_ARGUMENTS),
    LAYOUT_CONSTANT(BRIGHTEN_ARGUMENTS),
    LAYOUT_END,
};

/* Whether two measured ranges lie on one surface. */
static inline int on_one_surface(float one, float other, float may_differ)
{
    return one > 0 && other > 0 && fabsf(one - other) < may_differ * (one < other ? one : other);
}

/* Fills a gap. The range is negative until all gaps of a step are found, so that no gap is filled from another one. */
static inline void fill(float *ranges, float *intensities, int64_t at, float range, float intensity)
{
    ranges[at] = -range;
    intensities[at] = intensity;
}

/* cells: range, m, and intensity (2, rows x around); a range of 0 is a gap. Fills them in place. */
WIDE void streetfix_fill(float *cells, int64_t rows, int64_t around)
{
    const int64_t count = rows * around;
    float *ranges = cells, *bright = cells + count;
    for (int64_t gap = 1; gap <= GAPS; gap++)
        for (int64_t offset = 1; offset <= gap; offset++) {
            const int64_t up = offset * around, down = (gap + 1 - offset) * around;
            const float may_differ = (float)(0.10 + 0.05 * (double)gap), share = (float)((double)offset / (double)(gap + 1)),
                        rest = 1 - share;
            for (int64_t at = up; at < count - down; at++)
                if (ranges[at] == 0 && on_one_surface(ranges[at - up], ranges[at + down], may_differ))
                    fill(ranges, bright, at, rest * ranges[at - up] + share * ranges[at + down],
                         rest * bright[at - up] + share * bright[at + down]);
            for (int64_t at = up; at < count - down; at++) ranges[at] = fabsf(ranges[at]);
        }
    for (int64_t row = 0; row < rows; row++)
        for (int64_t column = 0; column < around; column++) {
            const int64_t at = row * around + column, left = column > 0 ? at - 1 : at + around - 1;
            const int64_t right = column < around - 1 ? at + 1 : at + 1 - around;
            if (ranges[at] == 0 && on_one_surface(ranges[left], ranges[right], 0.10f))
                fill(ranges, bright, at, 0.5f * (ranges[left] + ranges[right]), 0.5f * (bright[left] + bright[right]));
        }
    for (int64_t at = 0; at < count; at++) ranges[at] = fabsf(ranges[at]);
}

/* Sum in the order of NumPy: blocks of up to 128 numbers with eight partial sums. squared: of (number - centre) squared. */
static float sum_of(const float *numbers, int64_t count, int squared, float centre)
{
    if (count > 128) {
        const int64_t half = count / 2 - count / 2 % 8;
        return sum_of(numbers, half, squared, centre) + sum_of(numbers + half, count - half, squared, centre);
    }
    float terms[128], total = -0.0f;
    for (int64_t i = 0; i < count; i++) {
        const float off = numbers[i] - centre;
        terms[i] = squared ? off * off : numbers[i];
    }
    int64_t i = 0;
    if (count >= 8) {
        float part[8];
        for (int k = 0; k < 8; k++) part[k] = terms[k];
        for (i = 8; i < count - count % 8; i += 8)
            for (int k = 0; k < 8; k++) part[k] += terms[i + k];
        total = ((part[0] + part[1]) + (part[2] + part[3])) + ((part[4] + part[5]) + (part[6] + part[7]));
    }
    for (; i < count; i++) total += terms[i];
    return total;
}

static inline float mean_of(const float *numbers, int64_t count)
{
    return count > 0 ? (0 + sum_of(numbers, count, 0, 0)) / (float)count : 0;
}

/* kept: range, m, 0 where nothing counts as measured; height, m; intensity; inside: 1 where a cell counts as measured, otherwise 0 (rows,
 * around). columns: of each view in these arrays (views, width). Writes the planes of range and height to planes (views, PLANES, rows,
 * width). Writes the intensities of the measured cells, view by view, as a share of their mean plus ``floor_share``, to shares (views x rows x
 * width), and their numbers to counts (views). A view whose mean is not positive has the count -1 and no shares. Returns how many shares. */
int64_t streetfix_cut(const float *kept, const float *height, const float *intensity, const uint8_t *inside, int64_t rows, int64_t around,
                      const int64_t *columns, int64_t views, int64_t width, float floor_share, float *planes, float *shares,
                      int64_t *counts)
{
    int64_t total = 0;
    for (int64_t view = 0; view < views; view++) {
        float *of_view = planes + view * PLANES * rows * width, *share = shares + total;
        int64_t count = 0;
        for (int64_t row = 0; row < rows; row++)
            for (int64_t k = 0; k < width; k++) {
                const int64_t at = row * around + columns[view * width + k], cell = row * width + k;
                of_view[RANGE * rows * width + cell] = kept[at];
                of_view[HEIGHT * rows * width + cell] = height[at];
                share[count] = intensity[at];
                count += inside[at];
            }
        const float mean = mean_of(share, count);
        for (int64_t i = 0; i < count; i++) share[i] = share[i] / mean + floor_share;
        counts[view] = mean > 0 ? count : -1;
        total += mean > 0 ? count : 0;
    }
    return total;
}

/* inside, rows, around, columns, views, width and counts: as of streetfix_cut. logarithms: of its shares. Writes the plane of brightness to
 * planes: standard deviations from the mean of the view, at most ``limit``. A view with a smaller deviation than ``least`` keeps its plane. */
void streetfix_brighten(const uint8_t *inside, int64_t rows, int64_t around, const int64_t *columns, int64_t views, int64_t width,
                        const int64_t *counts, const float *logarithms, double least, double limit, float *planes)
{
    const float most = (float)limit;
    for (int64_t view = 0; view < views; view++) {
        const int64_t count = counts[view];
        if (count < 0) continue;
        const float middle = mean_of(logarithms, count);
        const float spread = sqrtf((0 + sum_of(logarithms, count, 1, middle)) / (float)count);
        const float *next = logarithms;
        logarithms += count;
        if (spread < least) continue;
        float *bright = planes + (view * PLANES + BRIGHTNESS) * rows * width;
        for (int64_t row = 0; row < rows; row++)
            for (int64_t k = 0; k < width; k++)
                if (inside[row * around + columns[view * width + k]]) {
                    const float scaled = (*next++ - middle) / spread, above = scaled < -most ? -most : scaled;
                    bright[row * width + k] = above > most ? most : above;
                }
    }
}
