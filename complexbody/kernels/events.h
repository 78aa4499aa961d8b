/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Asynchronous events: W cells act once at a common time, each with its own step as weight.
 *
 * At an event of cell K at t (paper (Discr-dAL1), (Discr-dAL2)): its nodes drift to t, the force is
 * taken there, and each node is kicked by h_K f. Behind drifts.h. */

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
    r[l] = (vec){a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]};
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

/* Kick the nodes of W cells: rate += weight f / (volume m); shared nodes collect. */
INLINE void kick(const world *s, const int32_t *c, const vec weight, const vec in[NR]) {
  if (collects(s, c) || SLOW || (NR < W && NR != 4)) {
    for (int l = 0; l < W; l++) {
      const int64_t a = c[l];
      double *r = record_of(s, a), f[N];
      for (int i = 0; i < N; i++) f[i] = in[i][l];
      if (a >= s->late && a < s->beyond)
        for (int i = 0; i < N; i++) s->collected[(a - s->late) * NR + i] += weight[l] * f[i];
      else
        impulse(s, a, f, weight[l] * r[INVERSE], r + NR);
    }
    return;
  }
#if !SLOW && NR >= W
  for (int g = 0; g < NR; g += W) {
    vec f[W];
    for (int i = 0; i < W; i++) f[i] = weight * in[g + i];
    transpose(f);
    for (int l = 0; l < W; l++) {
      double *r = record_of(s, c[l]);
      const double *m = s->inverse_mass + (s->klass ? s->klass[c[l]] : 0) * NR + g;
      *(vec_u *)(r + NR + g) += r[INVERSE] * *(const vec_u *)m * f[l];
    }
  }
#elif !SLOW && NR == 4
  vec f[4];
  for (int i = 0; i < 4; i++) f[i] = weight * in[i];
  transpose4(f);
  for (int l = 0; l < W; l++) {
    const vec p = f[l % 4];
    const nvec q = l < 4 ? (nvec){p[0], p[1], p[2], p[3]} : (nvec){p[4], p[5], p[6], p[7]};
    double *r = record_of(s, c[l]);
    const double *m = s->inverse_mass + (s->klass ? s->klass[c[l]] : 0) * NR;
    *(nvec *)(r + NR) += r[INVERSE] * *(const nvec *)m * q;
  }
#endif
}

/* What a block does besides kicking: keep its stress, or act against the reference. */
enum { KEEP = 1, AGAINST = 2 };

/* Where the stress of a component along an axis stands among the references. */
#if REFERENCES
static const int slot[N * DIM] = PLACES;

/* Leave stresses (times r, the root of the volume) behind: node += r stress, once per window. */
__attribute__((unused, noinline)) static void keep(const world *s, const int32_t *c, vec r,
                                                   const vec *stress) {
  for (int g = 0; g < ROWS; g++) {
    vec row[W];
    for (int i = 0; i < W; i++)
      row[i] = g * W + i < REFERENCES ? r * stress[g * W + i] : (vec){0};
    transpose(row);
    for (int l = 0; l < W; l++)
      for (int a = 0; a <= DIM; a++)
        *(vec_u *)(s->stress + (int64_t)c[a * W + l] * ROWS * W + g * W) += row[l];
  }
}
#endif

/* An event of cells whose density is not quadratic: forces and mean stresses by FFCx. */
__attribute__((unused)) static void tabulated_event(
    const tabulated *force, const tabulated *stress, int64_t blocks, int64_t first, const int32_t *c,
    const double *geometry, const double *held, const world *s, double weight, int mode) {
  const int zero = 0; const uint8_t none = 0;
  double w[force->before + force->after + stress->before + stress->after + LOCAL + 1];
  double at[3 * (DIM + 1)], out[LOCAL], mean[REFERENCES + 1];
  for (int64_t m = 0; m < blocks; m++, c += (DIM + 1) * W) {
    const vec *b = (const vec *)(geometry + m * GEOMETRY * W);
    vec f[DIM + 1][NR], left[ROWS * W + 1];
    memset(f, 0, sizeof f);
    memset(left, 0, sizeof left);
    for (int l = 0; l < W && c[l] < s->nodes; l++) {
      if (force->function) {
        tabulated_input(force, first + m, l, c, s->record, RECORD, s->coordinates, w, at);
        memset(out, 0, sizeof out);
        force->function(out, w, force->constants, at, &zero, &none, 0);
        for (int a = 0; a <= DIM; a++)
          for (int i = 0; i < N; i++) f[a][i][l] = -out[a * N + i];
      }
      if ((mode & KEEP) && REFERENCES && stress->function) {
        tabulated_input(stress, first + m, l, c, s->record, RECORD, s->coordinates, w, at);
        memset(mean, 0, sizeof mean);
        stress->function(mean, w, stress->constants, at, &zero, &none, 0);
        for (int i = 0; i < REFERENCES; i++) /* the mean times sqrt|K| */
          left[i][l] = mean[i] / b[DIM * DIM][l];
      }
    }
#if REFERENCES
    if (mode & KEEP) keep(s, c, b[DIM * DIM], left);
    if (mode & AGAINST) {
      const vec *r = (const vec *)(held + m * REFERENCES * W);
      for (int i = 0; i < N; i++) {
        const vec z = REFERENCES > STRESSES ? r[STRESSES + i] * b[DIM * DIM] / (DIM + 1.0) : (vec){0};
        for (int a = 1; a <= DIM; a++) {
          vec y = {0};
          for (int j = 0; j < DIM; j++) y += r[slot[i * DIM + j]] * b[(a - 1) * DIM + j];
          f[a][i] += y + z;
          f[0][i] -= y;
        }
        f[0][i] += z;
      }
    }
#endif
    for (int a = 0; a <= DIM; a++) kick(s, c + a * W, (vec){0} + weight, f[a]);
  }
}
