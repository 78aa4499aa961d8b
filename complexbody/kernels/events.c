/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Replay of windows: events in order, boundaries of windows, references. Behind events.h and the
 * regions' event functions; needs EVENT(region, ...), without which there is no replay. */

#ifdef EVENT
/* Chunk by chunk, nodes drift and cells kick: what drifts together is still in cache when kicked. */
static void act(const world *s, const group *g, double t, double weight, int mode) {
  const int64_t *from = s->touched_from + g->chunk;
  for (int64_t m = g->first; m < g->last; m += CHUNK, from++) {
    const int64_t blocks = m + CHUNK < g->last ? CHUNK : g->last - m;
    drift_all(s, s->touched + from[0], from[1] - from[0], t);
    EVENT(g->region, blocks, m, s->cell + m * (DIM + 1) * W, s->geometry + m * GEOMETRY * W,
          s->coefficient + m * COEFFICIENTS * W, s->reference + m * REFERENCES * W, s, weight, mode);
  }
}

/* Events [first, last) of the window's list. */
void cb_replay(const world *s, const happening *list, int64_t first, int64_t last, int mode) {
  for (int64_t i = first; i < last; i++) {
    const group *g = s->groups + list[i].group;
    act(s, g, s->start + list[i].time, g->step, mode);
  }
}

/* All cells of groups [first, last) at t with `part` of their steps as weight; keeps afresh. */
void cb_together(const world *s, int64_t first, int64_t last, double t, double part, int mode) {
  if (mode & KEEP) memset(s->stress, 0, (s->nodes + 1) * ROWS * W * sizeof(double));
  for (int64_t i = first; i < last; i++) act(s, s->groups + i, t, part * s->groups[i].step, mode);
}
#endif

void cb_drift(const world *s, int64_t first, int64_t last, double t) {
  for (int64_t a = first; a < last; a += W) {
    int32_t some[W];
    for (int l = 0; l < W; l++) some[l] = (int32_t)(a + l < last ? a + l : last - 1);
    drift(s, some, (vec){0} + t);
  }
}

/* Kicks of shared nodes, collected and summed over ranks, at time t, for the `count` nodes whose cells
 * acted on some rank: they drift even if no force comes of it. Empties the collection. */
void cb_apply(const world *s, double t, const int32_t *rows, int64_t count) {
  for (int64_t j = 0; j < count; j++) {
    const int64_t a = s->late + rows[j];
    double *sum = s->collected + (int64_t)rows[j] * NR, *r = record_of(s, a);
    int32_t some[W];
    for (int l = 0; l < W; l++) some[l] = (int32_t)a;
    drift(s, some, (vec){0} + t);
    impulse(s, a, sum, r[INVERSE], r + NR);
    memset(sum, 0, NR * sizeof(double));
  }
}

#if BALANCED
/* Kept stresses carried to mid-window, stress + (stress - old)/2, and old = stress. */
void cb_carry(const world *s, double *restrict old, double *restrict node) {
  for (int64_t i = 0; i < s->nodes * ROWS * W; i++) {
    node[i] = 1.5 * s->stress[i] - 0.5 * old[i];
    old[i] = s->stress[i];
  }
}

/* node /= (d + 1) volume: what cells added up becomes a volume average. */
void cb_scale_nodes(const world *s, double *node) {
  for (int64_t a = 0; a < s->nodes; a++) {
    const double w = record_of(s, a)[INVERSE] / (DIM + 1.0);
    for (int i = 0; i < ROWS * W; i++) node[a * ROWS * W + i] *= w;
  }
}

/* out += volume times the mean over the cell's vertices: one pass of smoothing, not yet scaled. */
void cb_smooth(const world *s, int64_t blocks, const double *in, double *out) {
  const int32_t *c = s->cell;
  for (int64_t m = 0; m < blocks; m++, c += (DIM + 1) * W) {
    const double *r = s->geometry + (m * GEOMETRY + DIM * DIM) * W;
    for (int l = 0; l < W; l++)
      for (int g = 0; g < ROWS * W; g += W) {
        vec row = {0};
        for (int a = 0; a <= DIM; a++) row += *(const vec_u *)(in + (int64_t)c[a * W + l] * ROWS * W + g);
        row *= r[l] * r[l] / (DIM + 1.0);
        for (int a = 0; a <= DIM; a++) *(vec_u *)(out + (int64_t)c[a * W + l] * ROWS * W + g) += row;
      }
  }
}

/* reference = sqrt|K| times the mean over the cell's vertices, and its nodal forces (partial),
 * F_a -= s B_a + z r/(d+1): [node][NR]. */
void cb_to_cells(const world *s, int64_t blocks, const double *node, double *force) {
  const int32_t *c = s->cell;
  for (int64_t m = 0; m < blocks; m++, c += (DIM + 1) * W) {
    const vec *b = (const vec *)(s->geometry + m * GEOMETRY * W), r = b[DIM * DIM] / (DIM + 1.0);
    vec *t = (vec *)(s->reference + m * REFERENCES * W);
    for (int g = 0; g < ROWS; g++) {
      vec row[W];
      for (int l = 0; l < W; l++) {
        row[l] = (vec){0};
        for (int a = 0; a <= DIM; a++)
          row[l] += *(const vec_u *)(node + (int64_t)c[a * W + l] * ROWS * W + g * W);
      }
      transpose(row);
      for (int i = 0; i < W && g * W + i < REFERENCES; i++) t[g * W + i] = r * row[i];
    }
    vec f[DIM + 1][NR] = {{{0}}};
    for (int i = 0; i < N; i++) {
      const vec z = REFERENCES > STRESSES ? t[STRESSES + i] * r : (vec){0};
      for (int a = 1; a <= DIM; a++) {
        vec y = {0};
        for (int j = 0; j < DIM; j++) y += t[slot[i * DIM + j]] * b[(a - 1) * DIM + j];
        f[a][i] = -y - z;
        f[0][i] += y;
      }
      f[0][i] -= z;
    }
    for (int a = 0; a <= DIM; a++) scatter(force, c + a * W, f[a]);
  }
}

/* The constant accelerations of a window, from nodal forces [node][NR]. */
void cb_accelerate(const world *s, const double *force) {
  for (int64_t a = 0; a < s->nodes; a++) {
    double *r = record_of(s, a);
    for (int i = 0; i < N; i++) r[2 * NR + i] = 0;
    impulse(s, a, force + a * NR, r[INVERSE], r + 2 * NR);
  }
}

#endif

/* The average over cells and back, S: out[a] += sum of weight (sum over vertices of in), with weight
 * the cell's mass / (d+1)^2: sums of mass times rate stay what they are. */
void cb_average(const world *s, int64_t blocks, const double *weight, const double *in, double *out) {
  const int32_t *c = s->cell;
  for (int64_t m = 0; m < blocks; m++, c += (DIM + 1) * W) {
    for (int l = 0; l < W; l++) {
      const double w = weight[m * W + l];
      for (int g = 0; g < NR; g += VN) {
        nvec row = {0};
        for (int a = 0; a <= DIM; a++) row += *(const nvec *)(in + (int64_t)c[a * W + l] * NR + g);
        for (int a = 0; a <= DIM; a++) *(nvec *)(out + (int64_t)c[a * W + l] * NR + g) += w * row;
      }
    }
  }
}

/* rates -= S rates, with out = S rates not yet divided by the nodes' masses; out = 0 again. */
void cb_subtract_average(const world *s, const double *inverse, double *rates, double *out) {
  for (int64_t a = 0; a < s->nodes; a++) {
    const double iv = inverse[a];
    for (int g = 0; g < NR; g += VN) {
      *(nvec *)(rates + a * NR + g) -= iv * *(const nvec *)(out + a * NR + g);
      *(nvec *)(out + a * NR + g) = (nvec){0};
    }
  }
}

/* The records' rates += amount * change where they are free: rates, not their basis's. Returns the
 * kinetic energy this takes away. */
double cb_change_rates(const world *s, double amount, const double *change) {
  double lost = 0;
  for (int64_t a = 0; a < s->nodes; a++) {
    double *r = record_of(s, a), *y = r + NR, sum = 0;
    const int64_t k = s->klass ? s->klass[a] : 0;
    for (int i = 0; i < N; i++) {
      const double m = s->inverse_mass[k * NR + i], old = y[i];
      if (m == 0 || s->compliance[k * NR + i] != 0) continue;
#if SLOW
      double part = 0;
      for (int j = 0; j < N; j++) part += s->inverse_basis[(k * N + i) * N + j] * change[a * NR + j];
      y[i] += amount * part;
#else
      y[i] += amount * change[a * NR + i];
#endif
      sum += (old * old - y[i] * y[i]) / m;
    }
    if (s->counted[a]) lost += 0.5 * sum / r[INVERSE];
  }
  return lost;
}

/* A kick of all nodes by nodal forces [node][NR]. */
void cb_push(const world *s, double weight, const double *force) {
  for (int64_t a = 0; a < s->nodes; a++) {
    double *r = record_of(s, a);
    impulse(s, a, force + a * NR, weight * r[INVERSE], r + NR);
  }
}

/* rates = the records' rates, [node][NR]; zero for components without inertia. */
void cb_get_rates(const world *s, double *rates) {
  for (int64_t a = 0; a < s->nodes; a++) {
    const double *y = record_of(s, a) + NR;
#if SLOW
    const int64_t k = s->klass ? s->klass[a] : 0;
    for (int i = 0; i < N; i++) {
      double sum = 0;
      for (int j = 0; j < N; j++)
        sum += s->compliance[k * NR + j] == 0 ? s->basis[(k * N + i) * N + j] * y[j] : 0.0;
      rates[a * NR + i] = sum;
    }
#else
    memcpy(rates + a * NR, y, NR * sizeof(double));
#endif
  }
}
