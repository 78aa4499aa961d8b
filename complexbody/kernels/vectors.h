/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Lanes: W cells are worked on at a time, one per lane of a vector.
 * Needs W (lanes), NR (doubles per node record, padded) defined before. */
#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double vec __attribute__((vector_size(8 * W)));
typedef long long ivec __attribute__((vector_size(8 * W)));
typedef double vec_u __attribute__((vector_size(8 * W), aligned(8)));
#define INLINE static inline __attribute__((always_inline))
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, (ivec){__VA_ARGS__})
#define CW (NR < W ? NR : W) /* components moved at a time */

#if W == 8
typedef double half __attribute__((vector_size(32), aligned(8)));
/* Halves by one instruction each: element by element they take half of a force's time. */
#ifdef __has_builtin
#define HALVES __has_builtin(__builtin_shufflevector)
#else
#define HALVES 0
#endif
typedef double pair __attribute__((vector_size(16), aligned(8)));
#if HALVES
#define PAIR(v, i) __builtin_shufflevector(v, v, 2 * (i), 2 * (i) + 1)
#define LOW(v) __builtin_shufflevector(v, v, 0, 1, 2, 3)
#define HIGH(v) __builtin_shufflevector(v, v, 4, 5, 6, 7)
#define JOIN(a, b) __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7)
#else
#define LOW(v) ((half){(v)[0], (v)[1], (v)[2], (v)[3]})
#define HIGH(v) ((half){(v)[4], (v)[5], (v)[6], (v)[7]})
#define JOIN(a, b) ((vec){(a)[0], (a)[1], (a)[2], (a)[3], (b)[0], (b)[1], (b)[2], (b)[3]})
#endif
/* Transpose an 8 x 8 block held in 8 vectors. */
INLINE void transpose(vec r[W]) {
  vec s[8], t[8];
  for (int i = 0; i < 8; i += 2) {
    s[i] = SHUFFLE(r[i], r[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    s[i + 1] = SHUFFLE(r[i], r[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 8; i += 4)
    for (int j = 0; j < 2; j++) {
      t[i + j] = SHUFFLE(s[i + j], s[i + j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      t[i + j + 2] = SHUFFLE(s[i + j], s[i + j + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
  for (int i = 0; i < 4; i++) {
    r[i] = SHUFFLE(t[i], t[i + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    r[i + 4] = SHUFFLE(t[i], t[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
}
/* Four rows of two cells each <-> four components over eight lanes. */
INLINE void transpose4(vec r[4]) {
  vec s[4];
  for (int i = 0; i < 4; i += 2) {
    s[i] = SHUFFLE(r[i], r[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    s[i + 1] = SHUFFLE(r[i], r[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 2; i++) {
    r[i] = SHUFFLE(s[i], s[i + 2], 0, 1, 8, 9, 4, 5, 12, 13);
    r[i + 2] = SHUFFLE(s[i], s[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
  }
}
#elif W == 4
INLINE void transpose(vec r[W]) {
  vec s[4];
  for (int i = 0; i < 4; i += 2) {
    s[i] = SHUFFLE(r[i], r[i + 1], 0, 4, 2, 6);
    s[i + 1] = SHUFFLE(r[i], r[i + 1], 1, 5, 3, 7);
  }
  for (int i = 0; i < 2; i++) {
    r[i] = SHUFFLE(s[i], s[i + 2], 0, 1, 4, 5);
    r[i + 2] = SHUFFLE(s[i], s[i + 2], 2, 3, 6, 7);
  }
}
#else
#error "W must be 4 or 8"
#endif

/* Components of the records of nodes c[0..W) of x, one component per vector. */
INLINE void gather(const double *restrict x, const int32_t *c, vec out[NR]) {
#if NR >= W
  for (int g = 0; g < NR; g += W) {
    vec r[W];
    for (int l = 0; l < W; l++) r[l] = *(const vec_u *)(x + (int64_t)c[l] * NR + g);
    transpose(r);
    for (int i = 0; i < W; i++) out[g + i] = r[i];
  }
#elif NR == 4
  vec r[4];
  for (int l = 0; l < 4; l++) {
    half a = *(const half *)(x + 4 * (int64_t)c[l]), b = *(const half *)(x + 4 * (int64_t)c[l + 4]);
    r[l] = JOIN(a, b);
  }
  transpose4(r);
  for (int i = 0; i < 4; i++) out[i] = r[i];
#elif NR == 2 && W == 8 && HALVES
#define AT(l) (*(const pair *)(x + 2 * (int64_t)c[l]))
  const half a = __builtin_shufflevector(AT(0), AT(1), 0, 1, 2, 3), b = __builtin_shufflevector(AT(2), AT(3), 0, 1, 2, 3);
  const half d = __builtin_shufflevector(AT(4), AT(5), 0, 1, 2, 3), e = __builtin_shufflevector(AT(6), AT(7), 0, 1, 2, 3);
#undef AT
  const vec low = JOIN(a, b), high = JOIN(d, e);
  out[0] = SHUFFLE(low, high, 0, 2, 4, 6, 8, 10, 12, 14);
  out[1] = SHUFFLE(low, high, 1, 3, 5, 7, 9, 11, 13, 15);
#else
  for (int l = 0; l < W; l++)
    for (int i = 0; i < NR; i++) out[i][l] = x[(int64_t)c[l] * NR + i];
#endif
}

/* Add to the records of nodes c[0..W) of f, cell after cell: nodes may repeat. */
INLINE void scatter(double *restrict f, const int32_t *c, const vec in[NR]) {
#if NR >= W
  for (int g = 0; g < NR; g += W) {
    vec r[W];
    for (int i = 0; i < W; i++) r[i] = in[g + i];
    transpose(r);
    for (int l = 0; l < W; l++) *(vec_u *)(f + (int64_t)c[l] * NR + g) += r[l];
  }
#elif NR == 4
  vec r[4];
  for (int i = 0; i < 4; i++) r[i] = in[i];
  transpose4(r);
  for (int l = 0; l < 4; l++) *(half *)(f + 4 * (int64_t)c[l]) += LOW(r[l]);
  for (int l = 0; l < 4; l++) *(half *)(f + 4 * (int64_t)c[l + 4]) += HIGH(r[l]);
#elif NR == 2 && W == 8 && HALVES
  const vec low = SHUFFLE(in[0], in[1], 0, 8, 1, 9, 2, 10, 3, 11), high = SHUFFLE(in[0], in[1], 4, 12, 5, 13, 6, 14, 7, 15);
#define ADD(l, v, i) *(pair *)(f + 2 * (int64_t)c[l]) += PAIR(v, i)
  ADD(0, low, 0); ADD(1, low, 1); ADD(2, low, 2); ADD(3, low, 3);
  ADD(4, high, 0); ADD(5, high, 1); ADD(6, high, 2); ADD(7, high, 3);
#undef ADD
#else
  for (int l = 0; l < W; l++)
    for (int i = 0; i < NR; i++) f[(int64_t)c[l] * NR + i] += in[i][l];
#endif
}
