/* What a library and its Python module must agree on: sizes and offsets of shared structs, and shared constants.
 *
 * Each library exports one table, streetfix_layout, that ends with an entry without a name. service/compiled.py compares it with the
 * ctypes structures and NumPy dtypes when it loads the library. */
#ifndef STREETFIX_LAYOUT_H
#define STREETFIX_LAYOUT_H
#include <stddef.h>
#include <stdint.h>

typedef struct {
    const char *name;    /* STRUCT, STRUCT.field, or the name of a constant */
    int64_t offset;      /* bytes from the start of the struct; 0 for a struct and a constant */
    int64_t value;       /* size in bytes, or the constant */
} LayoutEntry;

#define LAYOUT_STRUCT(type) {#type, 0, (int64_t)sizeof(type)}
#define LAYOUT_FIELD(type, field) {#type "." #field, (int64_t)offsetof(type, field), (int64_t)sizeof(((type *)0)->field)}
#define LAYOUT_CONSTANT(name) {#name, 0, (name)}
#define LAYOUT_END {0, 0, 0}

#endif
