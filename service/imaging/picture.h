/* Size and intrinsics of an image, in the layout that Python passes (CPicture in as_c.py). */
#ifndef STREETFIX_PICTURE_H
#define STREETFIX_PICTURE_H
#include <stdint.h>

#include "../layout.h"

typedef struct {
    int64_t height, width;
    double fx, fy, cx, cy;
} Picture;

#define PICTURE_LAYOUT                                                                                              \
    LAYOUT_STRUCT(Picture), LAYOUT_FIELD(Picture, height), LAYOUT_FIELD(Picture, width), LAYOUT_FIELD(Picture, fx), \
        LAYOUT_FIELD(Picture, fy), LAYOUT_FIELD(Picture, cx), LAYOUT_FIELD(Picture, cy)

#endif
