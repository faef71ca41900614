/* Two lossless codecs of 16-bit depth pictures. */

/* Reverses the row filters of a 16-bit grey PNG (RFC 2083, section 6), in place. out gets height x width values in native byte order.
 * raw holds height rows, each of one filter byte and 2 x width sample bytes in big-endian order. Python has checked its size.
 * Returns height, or the index of the first row with an unknown filter. */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

static uint8_t paeth(int a, int b, int c)
{
    const int pa = abs(b - c), pb = abs(a - c), pc = abs(a + b - 2 * c);
    const int closer = pa <= pb ? a : b;
    return (uint8_t)((pa <= pb ? pa : pb) <= pc ? closer : c);
}

int64_t streetfix_unfilter(uint8_t *raw, int64_t height, int64_t width, uint16_t *out)
{
    const int64_t bytes = 2 * width;
    const uint8_t *above = NULL; /* the unfiltered row above; NULL counts as zeros */
    for (int64_t y = 0; y < height; y++) {
        uint8_t *row = raw + y * (bytes + 1) + 1;
        switch (row[-1]) {
            case 0:
                break;
            case 1:
                for (int64_t k = 2; k < bytes; k++) row[k] = (uint8_t)(row[k] + row[k - 2]);
                break;
            case 2:
                if (above)
                    for (int64_t k = 0; k < bytes; k++) row[k] = (uint8_t)(row[k] + above[k]);
                break;
            case 3:
                for (int64_t k = 0; k < bytes; k++) {
                    const int left = k < 2 ? 0 : row[k - 2], up = above ? above[k] : 0;
                    row[k] = (uint8_t)(row[k] + (left + up) / 2);
                }
                break;
            case 4: {
                if (!above) {
                    for (int64_t k = 2; k < bytes; k++) row[k] = (uint8_t)(row[k] + row[k - 2]);
                    break;
                }
                int a0 = 0, a1 = 0, c0 = 0, c1 = 0; /* bytes on the left (a) and above left (c), for both bytes of a sample */
                for (int64_t k = 0; k < bytes; k += 2) {
                    const int b0 = above[k], b1 = above[k + 1];
                    a0 = (uint8_t)(row[k] + paeth(a0, b0, c0));
                    a1 = (uint8_t)(row[k + 1] + paeth(a1, b1, c1));
                    row[k] = (uint8_t)a0;
                    row[k + 1] = (uint8_t)a1;
                    c0 = b0;
                    c1 = b1;
                }
                break;
            }
            default:
                return y;
        }
        for (int64_t x = 0; x < width; x++) out[y * width + x] = (uint16_t)(row[2 * x] << 8 | row[2 * x + 1]);
        above = row;
    }
    return height;
}

/* Reader of nibbles from little-endian 32-bit words, highest nibble first. A number is a sequence of nibbles: three bits of value,
 * lowest group first, and a fourth bit that is set if another nibble follows. */
typedef struct {
    const uint8_t *position, *end;
    uint32_t word;
    int remaining, is_invalid;
} Nibbles;

static uint32_t read_number(Nibbles *n)
{
    uint32_t value = 0;
    for (int shift = 0; shift < 32; shift += 3) {
        if (n->remaining == 0) {
            if (n->end - n->position < 4) {
                n->is_invalid = 1;
                return 0;
            }
            n->word =
                (uint32_t)n->position[0] | (uint32_t)n->position[1] << 8 | (uint32_t)n->position[2] << 16 | (uint32_t)n->position[3] << 24;
            n->position += 4;
            n->remaining = 8;
        }
        const uint32_t nibble = n->word >> 28;
        n->word <<= 4;
        n->remaining--;
        value |= (nibble & 7) << shift;
        if (!(nibble & 8)) return value;
    }
    n->is_invalid = 1;
    return 0;
}

/* Decodes RVL (Wilson, ISS 2017) as in ROS compressedDepth: runs of zeros alternate with runs of zigzag-coded differences.
 * Returns the number of decoded pixels. The number is less than pixels if the data are damaged or end early. */
int64_t streetfix_rvl(const uint8_t *data, int64_t length, int64_t pixels, uint16_t *out)
{
    Nibbles n = {data, data + length, 0, 0, 0};
    int64_t decoded = 0;
    uint32_t previous = 0;
    while (decoded < pixels) {
        const uint32_t zeros = read_number(&n);
        if (n.is_invalid || zeros > (uint64_t)(pixels - decoded)) return decoded;
        memset(out + decoded, 0, zeros * sizeof *out);
        decoded += zeros;
        const uint32_t values = read_number(&n);
        if (n.is_invalid || values > (uint64_t)(pixels - decoded) || (zeros == 0 && values == 0)) return decoded;
        for (uint32_t k = 0; k < values; k++) {
            const uint32_t zigzag = read_number(&n);
            if (n.is_invalid) return decoded;
            previous += (zigzag >> 1) ^ (0u - (zigzag & 1));
            out[decoded++] = (uint16_t)previous;
        }
    }
    return decoded;
}
