#ifndef STREETFIX_WIDE_H
#define STREETFIX_WIDE_H

/* Compiled twice, once for processors with wider registers; which one runs is decided when the library is loaded. Neither contracts
 * products and sums (ISO C), so their answers are equal. */
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((flatten, target_clones("avx2", "default")))
#else
#define WIDE
#endif

#endif
