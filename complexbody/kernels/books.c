/* SPDX-License-Identifier: LGPL-3.0-or-later
 * What a ledger and a sample need of the state: energies, rates at the step's own time. Behind
 * driver.c. Sums run in the order of chunks and nodes; what is quiet would add zero. */

/* Nodes [first, last) of range r: those chunk r finishes, or all behind them. */
#define EACH_RANGE(s)                                                                              \
  const activity *q_ = quiet(s);                                                                   \
  for (int64_t r_ = 0, first, last; r_ <= (s)->chunks; r_++)                                       \
    if (first = first_node(s, r_), last = r_ < (s)->chunks ? (s)->table[r_].nodes : (s)->nodes,    \
        !q_ || r_ == (s)->chunks || q_->stirred[r_])

/* out[2 r] += stored, out[2 r + 1] += potential energy of region r. */
void cb_energies(const state *s, double *out) {
  const activity *q = quiet(s);
  for (int64_t c = 0; c < s->chunks; c++) {
    const chunk *t = s->table + c;
    if (t->last > t->first && (!q || q->awake[c]))
      ENERGY(t->region, t->last - t->first, t->first, s->cell + t->first * (DIM + 1) * W,
             s->geometry + t->first * GEOMETRY * W, s->coefficient + t->first * COEFFICIENTS * W, s,
             out + 2 * t->region);
  }
}

/* rates = a v + b f / volume: rates at the step's own time; those of quiet nodes stay. */
void cb_rates(const state *s, const double *a, const double *b, double *rates) {
  EACH_RANGE(s) for (int64_t m = first; m < last; m++) {
    const int64_t k = s->klass ? s->klass[m] : 0;
    const double *v = s->v + m * NR, *f = s->f + m * NR;
    for (int i = 0; i < N; i++) {
#if DIAGONAL
      rates[m * NR + i] = a[k * NR + i] * v[i] + b[k * NR + i] * s->inverse_volume[m] * f[i];
#else
      double sum = 0;
      for (int j = 0; j < N; j++)
        sum += a[k * N * N + i * N + j] * v[j] + b[k * N * N + i * N + j] * s->inverse_volume[m] * f[j];
      rates[m * NR + i] = sum;
#endif
    }
  }
}

/* Half the sum over counted nodes of volume * w.m w on components [c0, c1), m per class (n x n). */
double cb_quadratic(const state *s, const double *matrix, const double *w, int64_t c0, int64_t c1) {
  double total = 0;
  EACH_RANGE(s) for (int64_t a = first; a < last; a++) {
    if (!s->counted[a]) continue;
    const double *m = matrix + (s->klass ? s->klass[a] : 0) * N * N, *r = w + a * NR;
    double sum = 0;
#if DIAGONAL
    for (int64_t i = c0; i < c1; i++) sum += m[i * N + i] * r[i] * r[i];
#else
    for (int64_t i = c0; i < c1; i++)
      for (int64_t j = c0; j < c1; j++) sum += m[i * N + j] * r[i] * r[j];
#endif
    total += 0.5 * s->volume[a] * sum;
  }
  return total;
}

/* Sum over counted nodes of f.(x - h v): forces on the positions one step before. */
double cb_force_before(const state *s) {
  double total = 0;
  EACH_RANGE(s) for (int64_t a = first; a < last; a++) {
    if (!s->counted[a]) continue;
    const double *x = s->x + a * NR, *v = s->v + a * NR, *f = s->f + a * NR;
    for (int i = 0; i < N; i++) total += f[i] * (x[i] - s->step * v[i]);
  }
  return total;
}
