/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Asynchronous events: W cells act once at a common time, each with its own step as weight.
 *
 * At an event of cell K at t (paper (Discr-dAL1), (Discr-dAL2)): its nodes drift to t, the force is
 * taken there, and each node is kicked by h_K f. BALANCED, a force acts through the step instead.
 * Behind drifts.h. */

/* Drift distinct nodes to t. */
INLINE void drift_all(const world *s, const int32_t *nodes, int64_t count, double t) {
  int64_t i = 0;
  for (; i + W <= count; i += W) drift(s, nodes + i, (vec){0} + t);
  if (i < count) {
    int32_t rest[W];
    for (int l = 0; l < W; l++) rest[l] = nodes[i + l < count ? i + l : count - 1];
    drift(s, rest, (vec){0} + t);
  }
}

/* Positions of the nodes of W cells, one component per vector. */
INLINE void gather_records(const world *s, const int32_t *c, vec out[NR]) {
#if NR >= W
  for (int g = 0; g < NR; g += W) {
    vec r[W];
    for (int l = 0; l < W; l++) r[l] = *(const vec_u *)(record_of(s, c[l]) + g);
    transpose(r);
    for (int i = 0; i < W; i++) out[g + i] = r[i];
  }
#elif NR == 4
  vec r[4];
  for (int l = 0; l < 4; l++) {
    const half a = *(const half *)record_of(s, c[l]), b = *(const half *)record_of(s, c[l + 4]);
    r[l] = JOIN(a, b);
  }
  transpose4(r);
  for (int i = 0; i < 4; i++) out[i] = r[i];
#else
  for (int l = 0; l < W; l++)
    for (int i = 0; i < N; i++) out[i][l] = record_of(s, c[l])[i];
#endif
}

/* Drift the nodes of W cells, each to its own t, and hand out their positions. */
INLINE void drift_gather(const world *s, const int32_t *c, const vec t, vec out[NR]) {
  drift(s, c, t);
  gather_records(s, c, out);
}

/* Ask for what a later block will read: groups are runs too short for the processor to foresee. */
INLINE void ahead(const vec *p, int size) {
  for (int i = 0; i < size; i++) __builtin_prefetch(p + 8 * size + i, 0, 2);
}

/* True if some of W nodes are shared and collect. */
INLINE int collects(const world *s, const int32_t *c) {
  if (s->late == s->beyond) return 0;
  const uint32_t late = (uint32_t)s->late, shared = (uint32_t)(s->beyond - s->late);
  int any = 0;
  for (int l = 0; l < W; l++) any |= (uint32_t)c[l] - late < shared;
  return any;
}

/* The nodes of W cells: rate (PART 1) or acceleration (2) += weight in / (volume m); shared ones collect. */
enum { RATE = 1, ACCELERATION = 2 };
INLINE void give(const world *s, const int32_t *c, const vec weight, const vec in[NR], const int PART) {
  if (collects(s, c) || !all_plain(s, c) || (NR < W && NR != 4)) {
    for (int l = 0; l < W; l++) {
      const int64_t a = c[l];
      double *r = record_of(s, a), f[N], *sum = s->collected + (a - s->late) * SENT + (PART - 1) * NR;
      for (int i = 0; i < N; i++) f[i] = in[i][l];
      if (a >= s->late && a < s->beyond)
        for (int i = 0; i < N; i++) sum[i] += weight[l] * f[i];
      else
        impulse(s, a, f, weight[l] * r[INVERSE], r + PART * NR);
    }
    return;
  }
#if NR >= W
  for (int g = 0; g < NR; g += W) {
    vec f[W];
    for (int i = 0; i < W; i++) f[i] = weight * in[g + i];
    transpose(f);
    for (int l = 0; l < W; l++) {
      double *r = record_of(s, c[l]);
      const double *m = s->inverse_mass + (s->klass ? s->klass[c[l]] : 0) * NR + g;
      *(vec_u *)(r + PART * NR + g) += r[INVERSE] * *(const vec_u *)m * f[l];
    }
  }
#elif NR == 4
  vec f[4];
  for (int i = 0; i < 4; i++) f[i] = weight * in[i];
  transpose4(f);
  for (int l = 0; l < W; l++) {
    const vec p = f[l % 4];
    const nvec q = l < 4 ? LOW(p) : HIGH(p);
    double *r = record_of(s, c[l]);
    const double *m = s->inverse_mass + (s->klass ? s->klass[c[l]] : 0) * NR;
    *(nvec *)(r + PART * NR) += r[INVERSE] * *(const nvec *)m * q;
  }
#endif
}

INLINE void kick(const world *s, const int32_t *c, const vec weight, const vec in[NR]) {
  give(s, c, weight, in, RATE);
}

#if BALANCED
/* Balanced: a force F acts on the node through the whole step h, and at its end
 *   F+ = (2 - k) f - (1 - k) F-,   kick h (f - (F+ + F-)/2) = (h k/2) (f - F-);
 * without viscosity k = 0: the mean of F before and behind is f, and nothing is left to kick with.
 * BEGIN: F+ = f. `held` is F of this vertex. */
enum { BEGIN = 1 };
INLINE void hold(const world *s, const int32_t *c, double h, const vec f[NR], vec *held,
                 const double *k, int mode) {
  const vec one = (vec){0} + 1.0;
  vec change[NR] = {{0}}, rest[NR] = {{0}};
  if (mode & BEGIN) {
    for (int i = 0; i < N; i++) held[i] = change[i] = f[i];
  } else {
    for (int i = 0; i < N; i++) {
      const vec wrong = f[i] - held[i];
      change[i] = (DAMPED ? 2.0 - k[i] : 2.0) * wrong;
      rest[i] = (DAMPED ? 0.5 * h * k[i] : 0.0) * wrong;
      held[i] += change[i];
    }
    if (DAMPED) kick(s, c, one, rest);
  }
  give(s, c, one, change, ACCELERATION);
}
#endif

/* An event of cells whose density is not quadratic: forces by FFCx. */
__attribute__((unused)) static void tabulated_event(const tabulated *force, int64_t blocks,
                                                    int64_t first, const int32_t *c, double *held,
                                                    const double *k, const world *s, double h,
                                                    int mode) {
  const int zero = 0; const uint8_t none = 0;
  double w[force->before + force->after + LOCAL + 1], at[3 * (DIM + 1)], out[LOCAL];
  for (int64_t m = 0; m < blocks; m++, c += (DIM + 1) * W) {
    vec f[DIM + 1][NR];
    memset(f, 0, sizeof f);
    for (int l = 0; l < W && c[l] < s->nodes && force->function; l++) {
      tabulated_input(force, first + m, l, c, s->record, RECORD, s->coordinates, w, at);
      memset(out, 0, sizeof out);
      force->function(out, w, force->constants, at, &zero, &none, 0);
      for (int a = 0; a <= DIM; a++)
        for (int i = 0; i < N; i++) f[a][i][l] = -out[a * N + i];
    }
    for (int a = 0; a <= DIM; a++)
#if BALANCED
      hold(s, c + a * W, h, f[a], (vec *)held + (m * (DIM + 1) + a) * N, k, mode);
#else
      kick(s, c + a * W, (vec){0} + h, f[a]);
#endif
  }
}
