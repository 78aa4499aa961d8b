/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Cells whose density is not quadratic: FFCx's tabulate_tensor, called cell after cell.
 *
 * A record per region: the functions, and what their coefficients array w holds: the unknowns
 * between constant packs of the user's own coefficients. */
typedef void (*tabulate)(double *, const double *, const double *, const double *, const int *,
                         const uint8_t *, void *);
typedef struct {
  tabulate function;       /* NULL if the form is identically zero */
  int64_t before, after;   /* doubles of w before and behind the unknowns */
  int64_t unknowns;        /* 1 if w holds the unknowns */
  const double *pack;      /* [block][lane][before + after] */
  const double *corners;   /* [block][lane][vertex][3] where nodes do not say where cells are, or NULL */
  const double *constants;
} tabulated;

#define LOCAL ((DIM + 1) * N)

/* w and coordinates of lane l of a block. */
INLINE void tabulated_input(const tabulated *t, int64_t block, int l, const int32_t *c,
                            const double *x, int stride, const double *coordinates, double *w,
                            double *at) {
  const double *pack = t->pack + (block * W + l) * (t->before + t->after);
  double *q = w + t->before;
  memcpy(w, pack, t->before * sizeof(double));
  for (int a = 0; a <= DIM; a++) {
    const int64_t node = c[a * W + l];
    memcpy(at + 3 * a, t->corners ? t->corners + 3 * ((block * W + l) * (DIM + 1) + a)
                                  : coordinates + 3 * node, 3 * sizeof(double));
    if (t->unknowns) memcpy(q + a * N, x + node * stride, N * sizeof(double));
  }
  memcpy(q + (t->unknowns ? LOCAL : 0), pack + t->before, t->after * sizeof(double));
}

#define TABULATED_LOOP(SIZE, USE)                                                                  \
  if (!t->function) return;                                                                        \
  double w[t->before + t->after + LOCAL + 1], at[3 * (DIM + 1)], out_[SIZE];                       \
  const int zero = 0; const uint8_t none = 0;                                                      \
  for (int64_t m = 0; m < blocks; m++, c += (DIM + 1) * W)                                         \
    for (int l = 0; l < W && c[l] < real; l++) {                                                   \
      tabulated_input(t, first + m, l, c, x, NR, coordinates, w, at);                                \
      memset(out_, 0, sizeof out_);                                                                \
      t->function(out_, w, t->constants, at, &zero, &none, 0);                                     \
      USE                                                                                          \
    }

/* f -= first derivative; cells of nodes at or above `real` are padding. */
__attribute__((unused)) static void tabulated_force(const tabulated *t, int64_t real, int64_t blocks, int64_t first,
                            const int32_t *c, const double *x, const double *coordinates, double *f) {
  TABULATED_LOOP(LOCAL, for (int a = 0; a <= DIM; a++) for (int i = 0; i < N; i++)
                            f[(int64_t)c[a * W + l] * NR + i] -= out_[a * N + i];)
}

__attribute__((unused)) static void tabulated_energy(const tabulated *t, int64_t real, int64_t blocks, int64_t first,
                             const int32_t *c, const double *x, const double *coordinates,
                             double *out) {
  TABULATED_LOOP(1, *out += out_[0];)
}

/* Sets *restless if the form of any of these cells is not zero at x. */
__attribute__((unused)) static void tabulated_rest(const tabulated *t, int64_t real, int64_t blocks, int64_t first,
                           const int32_t *c, const double *x, const double *coordinates,
                           uint8_t *restless) {
  TABULATED_LOOP(LOCAL, for (int i = 0; i < LOCAL; i++) if (!(out_[i] == 0)) *restless = 1;)
}

/* Element matrices, [block][lane][LOCAL][LOCAL]. */
void cb_tabulated_matrices(const tabulated *t, int64_t real, int64_t blocks, int64_t first,
                           const int32_t *c, const double *x, const double *coordinates, double *out) {
  TABULATED_LOOP(LOCAL * LOCAL,
                 memcpy(out + (m * W + l) * LOCAL * LOCAL, out_, sizeof out_);)
}
