/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Forces of cells that act alone: their softer potential, and cells whose density FFCx takes.
 * Behind events.h; needs CORRECTED. */

/* q += soft M^-1 f for one node; nothing where a component is prescribed or has no inertia. */
__attribute__((unused)) static void soften_node(const world *s, int64_t a, double soft,
                                                const double *f, double *q) {
  const int64_t k = s->klass ? s->klass[a] : 0;
  const double *m = s->inverse_mass + k * NR, *none = s->compliance + k * NR;
  soft *= record_of(s, a)[INVERSE];
#if SLOW
  const double *V = s->basis + k * N * N;
  double y[N];
  for (int i = 0; i < N; i++) {
    y[i] = 0;
    for (int j = 0; j < N; j++) y[i] += V[j * N + i] * f[j];
    y[i] *= none[i] != 0 ? 0.0 : soft * m[i];
  }
  for (int i = 0; i < N; i++)
    for (int j = 0; j < N; j++) q[i] += V[i * N + j] * y[j];
#else
  for (int i = 0; i < N; i++) q[i] += none[i] != 0 ? 0.0 : soft * m[i] * f[i];
#endif
}

/* The same for W nodes. */
INLINE void soften(const world *s, const int32_t *c, const vec soft, const vec f[NR], vec q[NR]) {
#if SLOW
  if (!all_plain(s, c)) {
    for (int l = 0; l < W; l++) {
      double force[N], at[N];
      for (int i = 0; i < N; i++) force[i] = f[i][l], at[i] = q[i][l];
      soften_node(s, c[l], soft[l], force, at);
      for (int i = 0; i < N; i++) q[i][l] = at[i];
    }
    return;
  }
#endif
  vec inverse;
  for (int l = 0; l < W; l++) inverse[l] = c[l] < s->nodes ? record_of(s, c[l])[INVERSE] : 0.0;
  inverse *= soft;
  if (!s->klass) {
    for (int i = 0; i < N; i++) q[i] += s->inverse_mass[i] * inverse * f[i];
    return;
  }
  for (int i = 0; i < N; i++) {
    vec m;
    for (int l = 0; l < W; l++) m[l] = s->inverse_mass[s->klass[c[l]] * NR + i];
    q[i] += m * inverse * f[i];
  }
}

/* Forces of up to W cells of a density that is not quadratic, each at its own time. */
__attribute__((unused)) static void tabulated_lone(const tabulated *force, const world *s,
                                                   const int32_t *c, const int32_t *cell,
                                                   const vec t, const vec soft, int count,
                                                   vec out[DIM + 1][NR]) {
  const int zero = 0; const uint8_t none = 0;
  double w[force->before + force->after + LOCAL + 1], at[3 * (DIM + 1)], f[LOCAL];
  memset(out, 0, (DIM + 1) * NR * sizeof(vec));
  for (int a = 0; a <= DIM; a++) drift(s, c + a * W, t);
  if (!force->function) return;
  for (int l = 0; l < count; l++) {
    tabulated one = *force; /* this cell's pack where lane l's would be */
    one.pack += (cell[l] - l) * (force->before + force->after);
    if (one.corners) one.corners += 3 * (DIM + 1) * (int64_t)(cell[l] - l);
    tabulated_input(&one, 0, l, c, s->record, RECORD, s->coordinates, w, at);
    for (int pass = 0; pass <= CORRECTED; pass++) {
      memset(f, 0, sizeof f);
      force->function(f, w, force->constants, at, &zero, &none, 0);
      for (int a = 0; a < LOCAL; a++) f[a] = -f[a];
      if (pass == CORRECTED || !force->unknowns) break;
      for (int a = 0; a <= DIM; a++)
        soften_node(s, c[a * W + l], soft[l], f + a * N, w + force->before + a * N);
    }
    for (int a = 0; a <= DIM; a++)
      for (int i = 0; i < N; i++) out[a][i][l] = f[a * N + i];
  }
}
