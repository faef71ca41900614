#ifndef STREETFIX_WIDE_H
#define STREETFIX_WIDE_H

/* Compiles a function twice: for every processor, and for processors with AVX2. The loader of the library chooses one. Neither version
 * contracts products and sums (ISO C), so both give equal answers. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((flatten, target_clones("avx2", "default")))
#else
#define WIDE
#endif

#endif
