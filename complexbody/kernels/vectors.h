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
    r[l] = (vec){a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]};
  }
  transpose4(r);
  for (int i = 0; i < 4; i++) out[i] = r[i];
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
  for (int l = 0; l < 4; l++) *(half *)(f + 4 * (int64_t)c[l]) += (half){r[l][0], r[l][1], r[l][2], r[l][3]};
  for (int l = 0; l < 4; l++) *(half *)(f + 4 * (int64_t)c[l + 4]) += (half){r[l][4], r[l][5], r[l][6], r[l][7]};
#else
  for (int l = 0; l < W; l++)
    for (int i = 0; i < NR; i++) f[(int64_t)c[l] * NR + i] += in[i][l];
#endif
}
