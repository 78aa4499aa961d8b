/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Largest eigenvalue of W symmetric matrices at a time: Householder's reduction to a tridiagonal
 * matrix T, then the largest root of det(x - T), enclosed from both sides.
 *
 * Assembled behind vectors.h; needs DIM (0: only cb_matrix_pencil). A symmetric matrix is its lower
 * triangle, row after row. */

#define ROW(i) ((int64_t)(i) * ((i) + 1) / 2)
#define TOLERANCE 3e-13 /* width of the last enclosure, relative to the Frobenius norm */
#define TINY 1e-290     /* below it a number counts as zero */
/* Small arrays of vectors must become registers: gcc would copy them through memory in halves. */
#define UNROLL _Pragma("GCC unroll 4")

INLINE vec where(ivec mask, vec a, vec b) { return (vec)(((ivec)a & mask) | ((ivec)b & ~mask)); }
INLINE vec larger(vec a, vec b) { return where((ivec)(a > b), a, b); }
INLINE vec magnitude(vec a) { return (vec)((ivec)a & INT64_MAX); }
INLINE vec inverse(vec a) { return where((ivec)(a > TINY), 1.0 / a, (vec){0}); } /* of zero: zero */
INLINE vec root(vec a) {
#if (W == 8 && defined __AVX512F__) || (W == 4 && defined __AVX__)
  __asm__("vsqrtpd %1, %0" : "=v"(a) : "v"(a)); /* gcc would go through memory */
#else
  for (int l = 0; l < W; l++) a[l] = sqrt(a[l]);
#endif
  return a;
}
INLINE int any(ivec mask) {
  long long found = 0;
  for (int l = 0; l < W; l++) found |= mask[l];
  return found != 0;
}
INLINE vec dot(int n, const vec *a, const vec *b) {
  vec s = {0}, t = {0}; /* two chains of sums */
  int i = 0;
  for (; i + 2 <= n; i += 2) s += a[i] * b[i], t += a[i + 1] * b[i + 1];
  return i < n ? s + t + a[i] * b[i] : s + t;
}
/* Not finite if an entry is not. */
INLINE vec sum_of_magnitudes(int64_t n, const vec *a) {
  vec s = {0}, t = {0};
  int64_t i = 0;
  for (; i + 2 <= n; i += 2) s += magnitude(a[i]), t += magnitude(a[i + 1]);
  return i < n ? s + t + magnitude(a[i]) : s + t;
}

/* Rows i .. i + R - 1 up to the diagonal: A -= u q' + q u', then p = A v as if A were whole. */
INLINE void update_rows(const int R, int i, vec *restrict A, const vec *restrict u,
                        const vec *restrict q, const vec *restrict v, vec *restrict p) {
  vec *a[4], ur[4], qr[4], vr[4], pr[4];
  UNROLL for (int r = 0; r < R; r++) a[r] = A + ROW(i + r);
  UNROLL for (int r = 0; r < R; r++) ur[r] = u[i + r];
  UNROLL for (int r = 0; r < R; r++) qr[r] = q[i + r];
  UNROLL for (int r = 0; r < R; r++) vr[r] = v[i + r];
  UNROLL for (int r = 0; r < R; r++) pr[r] = (vec){0};
  for (int j = 0; j < i; j++) {
    const vec uj = u[j], qj = q[j], vj = v[j];
    vec pj = p[j];
    UNROLL for (int r = 0; r < R; r++) {
      const vec x = a[r][j] - ur[r] * qj - qr[r] * uj;
      a[r][j] = x;
      pr[r] += x * vj;
      pj += x * vr[r];
    }
    p[j] = pj;
  }
  UNROLL for (int r = 0; r < R; r++) {
    UNROLL for (int c = 0; c < r; c++) {
      const vec x = a[r][i + c] - ur[r] * qr[c] - qr[r] * ur[c];
      a[r][i + c] = x;
      pr[r] += x * vr[c];
      pr[c] += x * vr[r];
    }
    const vec x = a[r][i + r] - 2.0 * ur[r] * qr[r];
    a[r][i + r] = x;
    pr[r] += x * vr[r];
  }
  UNROLL for (int r = 0; r < R; r++) p[i + r] = pr[r];
}

/* T = Q A Q': diagonal a, and |b[i]| couples i - 1 with i. Destroys A; work holds 3 m vectors. */
static void tridiagonal(int m, vec *A, vec *work, vec *a, vec *b) {
  const vec *u = work; /* what A still lacks: - u q' - q u' */
  vec *q = work + m, *p = work + 2 * m;
  for (int i = 0; i < 2 * m; i++) work[i] = (vec){0};
  for (int i = m - 1; i >= 0; i--) {
    vec *v = A + ROW(i);
    for (int j = 0; j <= i; j++) v[j] -= u[i] * q[j] + q[i] * u[j];
    const vec square = dot(i, v, v), norm = root(square);
    a[i] = v[i];
    b[i] = norm;
    if (i < 2) continue;
    /* Reflection I - v v'/h takes row i to (0 .. 0, -+norm). */
    const vec over = inverse(square + magnitude(v[i - 1]) * norm);
    v[i - 1] += where((ivec)(v[i - 1] < 0.0), -norm, norm);
    if (i % 4 == 1) update_rows(1, 0, A, u, q, v, p);
    if (i % 4 == 2) update_rows(2, 0, A, u, q, v, p);
    if (i % 4 == 3) update_rows(3, 0, A, u, q, v, p);
    for (int r = i % 4; r < i; r += 4) update_rows(4, r, A, u, q, v, p);
    const vec half = 0.5 * over * over * dot(i, v, p);
    for (int j = 0; j < i; j++) p[j] = over * p[j] - half * v[j];
    vec *swap = q;
    q = p, p = swap, u = v;
  }
}

/* s = p'/p and half = p''/2p of p = det(x - T); returns where x is above all roots: where the
 * leading minors, a Sturm sequence, are positive. e = b^2, e[0] = 0. */
INLINE ivec characteristic(int m, const vec *a, const vec *e, vec x, vec *s, vec *half) {
  vec f0 = {0}, g0 = {0}, h0 = {0}, f1 = f0 + 1.0, g1 = {0}, h1 = {0}; /* p, p', p''/2 */
  ivec sign = {0};
  for (int k = 0; k < m; k++) {
    const vec c = x - a[k], d = e[k];
    const vec f2 = c * f1 - d * f0, g2 = c * g1 + (f1 - d * g0), h2 = c * h1 + (g1 - d * h0);
    f0 = f1, g0 = g1, h0 = h1, f1 = f2, g1 = g2, h1 = h2;
    sign |= (ivec)f2;
    if (k % 16 == 15) { /* no overflow, no underflow */
      const vec over = 1.0 / f1;
      f0 *= over, g0 *= over, h0 *= over, f1 *= over, g1 *= over, h1 *= over;
    }
  }
  *s = g1 / f1, *half = h1 / f1;
  return (sign >= 0) & (ivec)(f1 > 0.0);
}

/* Largest root of p = det(x - T). With s = p'/p = sum 1/(x - r_i) and t = s^2 - p''/p =
 * sum 1/(x - r_i)^2 at x above all roots r_i, the largest lies between x - s/t and Laguerre's
 * x - m / (s + sqrt((m - 1)(m t - s^2))), which converges cubically unless the root is multiple:
 * then s^2/t tends to the multiplicity k, and m/k - 1 in the place of m - 1 restores the speed. A
 * guess that falls below the root (the signs tell) raises the lower end. Replaces b by b^2. */
static vec largest_root(int m, const vec *a, vec *b) {
  const vec n = (vec){0} + m;
  vec lo = a[0], hi = a[0], square = {0};
  for (int i = 0; i < m; i++) {
    lo = larger(lo, a[i]);
    hi = larger(hi, a[i] + b[i] + (i + 1 < m ? b[i + 1] : b[0])); /* Gershgorin */
  }
  for (int i = 0; i < m; i++) {
    b[i] *= b[i];
    square += a[i] * a[i] + 2.0 * b[i];
  }
  const vec tolerance = TOLERANCE * root(square), margin = 0.25 * tolerance;
  vec x = hi + margin, safe = x;
  ivec open = (ivec)(hi - lo > tolerance); /* a lane's end does not depend on its neighbours */
  for (int turn = 0; turn < 200 && any(open); turn++) {
    vec s, half;
    const ivec above = characteristic(m, a, b, x, &s, &half);
    const vec t = s * s - 2.0 * half, spread = larger((vec){0}, n * t - s * s);
    const vec least = x - s / t, laguerre = x - n / (s + root((n - 1.0) * spread)) + margin;
    lo = larger(lo, where(above, least, x));
    hi = where(above & open, x, hi);
    open &= (ivec)(hi - lo > tolerance);
    safe = where(above, laguerre, safe);
    vec next = safe;
    if (turn > 4) {
      vec k = s * s / t + 0.1;
      for (int l = 0; l < W; l++) k[l] = floor(k[l]);
      const vec guess = x - n / (s + root((n / k - 1.0) * spread));
      const ivec like = above & (ivec)(k > 1.0) & (ivec)(s * s / t < k + 0.3);
      next = where(like, guess + 0.5 * (guess - least) + margin, safe);
    }
    x = where((ivec)(next > lo) & (ivec)(next < hi), next, 0.5 * (lo + hi));
  }
  return hi;
}

/* Largest eigenvalues of W matrices, nan where one is not finite. Work holds 5 m vectors. */
static vec largest(int m, vec *A, vec *work) {
  const vec size = sum_of_magnitudes(ROW(m), A), over = inverse(size);
  for (int64_t i = 0; i < ROW(m); i++) A[i] *= over;
  tridiagonal(m, A, work + 2 * m, work, work + m);
  return size * largest_root(m, work, work + m) + (size - size);
}

#if DIM == 0
/* out = largest eigenvalues of diag(scale) A diag(scale); stride: from cell to cell of scale. */
void cb_matrix_pencil(int64_t cells, int64_t m, const double *matrix, const double *scale,
                      int64_t stride, double *scratch, double *out) {
  vec *A = (vec *)scratch, *row = A + ROW(m), *s = row + m, *work = s + m;
  for (int64_t first = 0; first < cells; first += W) {
    const double *a[W];
    for (int l = 0; l < W; l++) {
      const int64_t cell = first + l < cells ? first + l : cells - 1;
      a[l] = matrix + cell * m * m;
      for (int64_t i = 0; i < m; i++) s[i][l] = scale[cell * stride + i];
    }
    vec size = {0};
    for (int64_t i = 0; i < m; i++) {
      int64_t j = 0;
      for (; j + W <= m; j += W) {
        for (int l = 0; l < W; l++) row[j + l] = *(const vec_u *)(a[l] + i * m + j);
        transpose(row + j);
      }
      for (; j < m; j++)
        for (int l = 0; l < W; l++) row[j][l] = a[l][i * m + j];
      size += sum_of_magnitudes(m, row);
      memcpy(A + ROW(i), row, (i + 1) * sizeof(vec));
    }
    const vec width = sum_of_magnitudes(m, s), over = inverse(size);
    for (int64_t i = 0; i < m; i++) s[i] *= inverse(width);
    for (int64_t i = 0; i < m; i++)
      for (int64_t j = 0; j <= i; j++) A[ROW(i) + j] *= over * s[i] * s[j];
    const vec value = largest(m, A, work) * size * width * width + (size - size);
    for (int l = 0; l < W && first + l < cells; l++) out[first + l] = value[l];
  }
}

#else
/* Part of a cell's matrix, by members: one is a component's DIM gradient modes, or its mean value.
 * kind 0: gradients with gradients, 1: value with gradients, 2: value with value. Entries of H
 * with the gradient's direction k are at start[k] .. start[k + 1], H_vv at value (-1: none). */
typedef struct {
  int32_t row, column, i, k, kind, value, start[DIM + 1];
} part;

/* out = larger(out, largest eigenvalue of one group of members) for every cell.
 *
 * With vertices lumped alike, an orthogonal change between them keeps the pencil: means and
 * gradients separate, P_c = sqrt(d+1)/r (B_c + tau sum_a B_a), tau = (sqrt(d+1) - 1)/d, and
 *   A_gg = P H_GG P' + weight H_vv,  A_gv = P H_Gv,  A_vv = H_vv,  times scale_i scale_k.
 * entry: the values of H, of which slot lists those that vary and their coefficient. */
void cb_quadratic_pencil(int64_t blocks, int64_t rows, const double *geometry, int64_t coefficients,
                         const double *coefficient, int64_t stride, const double *scale, int64_t m,
                         int64_t parts, const part *table, const int32_t *direction, double *entry,
                         int64_t varying, const int32_t *slot, double weight, double *scratch,
                         double *out) {
  const double factor = sqrt(DIM + 1.0), tau = (factor - 1.0) / DIM;
  vec *A = (vec *)scratch, *work = A + ROW(m), *h = (vec *)entry;
  for (int64_t block = 0; block < blocks; block++) {
    const vec_u *B = (const vec_u *)(geometry + block * rows * W);
    const vec_u *given = (const vec_u *)(coefficient + block * coefficients * W);
    const vec_u *s = (const vec_u *)(scale + block * stride);
    const vec r = B[DIM * DIM];
    const ivec padding = (ivec)(r == 0.0);
    vec P[DIM][DIM]; /* [j][c] */
    for (int j = 0; j < DIM; j++) {
      vec sum = {0};
      for (int c = 0; c < DIM; c++) sum += B[c * DIM + j];
      for (int c = 0; c < DIM; c++)
        P[j][c] = where(padding, (vec){0}, factor / r * (B[c * DIM + j] + tau * sum));
    }
    for (int64_t i = 0; i < varying; i++) h[slot[2 * i]] = given[slot[2 * i + 1]];
    for (const part *t = table; t < table + parts; t++) {
      const vec both = s[t->i] * s[t->k];
      vec *a = A + ROW(t->row) + t->column;
      if (t->kind == 2) {
        *a = t->value < 0 ? (vec){0} : both * h[t->value];
        continue;
      }
      vec z[DIM][DIM];
      UNROLL for (int c = 0; c < DIM; c++) {
        UNROLL for (int l = 0; l < DIM; l++) z[c][l] = (vec){0};
      }
      for (int k = 0; k < DIM; k++) {
        vec y[DIM];
        UNROLL for (int c = 0; c < DIM; c++) y[c] = (vec){0};
        for (int e = t->start[k]; e < t->start[k + 1]; e++) {
          UNROLL for (int c = 0; c < DIM; c++)
            y[c] += t->kind == 1 ? h[e] : h[e] * P[direction[e]][c];
        }
        UNROLL for (int c = 0; c < DIM; c++) {
          UNROLL for (int l = 0; l < DIM; l++) z[c][l] += y[c] * P[k][l];
        }
      }
      if (t->kind == 1) {
        UNROLL for (int l = 0; l < DIM; l++) a[l] = both * z[0][l];
        continue;
      }
      if (t->value >= 0) {
        UNROLL for (int c = 0; c < DIM; c++) z[c][c] += weight * h[t->value];
      }
      UNROLL for (int c = 0; c < DIM; c++) {
        a = A + ROW(t->row + c) + t->column;
        UNROLL for (int l = 0; l < DIM; l++)
          if (t->row != t->column || l <= c) a[l] = both * z[c][l];
      }
    }
    const vec value = where(padding, (vec){0}, largest(m, A, work) + (r - r));
    vec_u *o = (vec_u *)(out + block * W);
    *o = where((ivec)(value > *o) | (ivec)(value != value), value, *o);
  }
}
#endif
