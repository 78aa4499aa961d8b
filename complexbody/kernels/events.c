/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Replay of windows: events in order, boundaries of windows. Behind events.h and the
 * regions' event functions; needs EVENT(region, ...), without which there is no replay, and RANGE. */

INLINE activity *quiet(const world *s) { return s->activity && s->activity->on ? s->activity : NULL; }

#ifdef EVENT
/* True if all nodes of chunk c are at zero: position, rate, acceleration. */
static int at_rest(const world *s, const activity *q, int64_t c) {
  for (int64_t i = q->node_from[c]; i < q->node_from[c + 1]; i++) {
    const double *r = record_of(s, q->node[i]);
    if (!at_zero(r, N) || !at_zero(r + NR, (PARTS - 1) * NR)) return 0;
  }
  return 1;
}

/* Chunk by chunk, nodes drift and cells kick: what drifts together is still in cache when kicked.
 * The time of a quiet node may lag behind: nothing is lost, since it moves as soon as it is told to. */
static void act(const world *s, const group *g, double t, double weight, int mode) {
  const int64_t *from = s->touched_from + g->chunk;
  activity *q = quiet(s);
  int64_t c = g->chunk;
  for (int64_t m = g->first; m < g->last; m += CHUNK, from++, c++) {
    const int64_t blocks = m + CHUNK < g->last ? CHUNK : g->last - m;
    const int quiet_so_far = q && !q->awake[c];
    if (quiet_so_far && !q->near[c]) {
      q->skipped += q->size[c];
      continue;
    }
    const int stays = quiet_so_far && at_rest(s, q, c);
    drift_all(s, s->touched + from[0], from[1] - from[0], t); /* awake neighbours count on it */
    if (stays) {
      q->skipped += q->size[c];
      continue;
    }
    if (quiet_so_far) { /* chunks before this one, which were quiet, have let its nodes lie */
      wake(q, c);
      drift_all(s, q->node + q->node_from[c], q->node_from[c + 1] - q->node_from[c], t);
    }
    EVENT(g->region, blocks, m, s->cell + m * (DIM + 1) * W, s->geometry + m * GEOMETRY * W,
          s->coefficient + m * COEFFICIENTS * W, s->held + m * HELD * W,
          s->blend + (g - s->groups) * NR, s, weight, mode);
  }
}

/* Events [first, last) of the window's list. */
void cb_replay(const world *s, const happening *list, int64_t first, int64_t last, int mode) {
  for (int64_t i = first; i < last; i++) {
    const group *g = s->groups + list[i].group;
    act(s, g, s->start + list[i].time, g->step, mode);
  }
}

/* All cells of groups [first, last) at t with `part` of their steps as weight. */
void cb_together(const world *s, int64_t first, int64_t last, double t, double part, int mode) {
  for (int64_t i = first; i < last; i++) act(s, s->groups + i, t, part * s->groups[i].step, mode);
}
#endif

/* All nodes to t, but for ranges that are quiet. */
void cb_drift(const world *s, double t) {
  const activity *q = quiet(s);
  const int64_t last = s->nodes;
  for (int64_t a = 0; a < last; a += W) {
    int32_t some[W];
    if (q && !q->stirred[a / RANGE]) continue;
    for (int l = 0; l < W; l++) some[l] = (int32_t)(a + l < last ? a + l : last - 1);
    drift(s, some, (vec){0} + t);
  }
}

/* What the cells of this rank gave to shared nodes (by position), into a message. */
void cb_pack_shared(const world *s, int64_t count, const int32_t *position, double *message) {
  for (int64_t i = 0; i < count; i++)
    memcpy(message + i * SENT, s->collected + (int64_t)position[i] * SENT, SENT * sizeof(double));
}

/* The sum of all ranks' parts, in the order of the ranks; source -1 is this rank's own. */
void cb_add_shared(const world *s, int64_t count, const int32_t *position, const int64_t *start,
                   const int64_t *source, const double *received) {
  for (int64_t i = 0; i < count; i++) {
    double *own = s->collected + (int64_t)position[i] * SENT, sum[SENT];
    memset(sum, 0, sizeof sum);
    for (int64_t j = start[i]; j < start[i + 1]; j++) {
      const double *part = source[j] < 0 ? own : received + source[j] * SENT;
      for (int c = 0; c < SENT; c++) sum[c] += part[c];
    }
    memcpy(own, sum, sizeof sum);
  }
}

/* Kicks of shared nodes, collected and summed over ranks, at time t, for the `count` nodes whose cells
 * acted on some rank: they drift even if no force comes of it. Empties the collection. */
void cb_apply(const world *s, double t, const int32_t *rows, int64_t count) {
  for (int64_t j = 0; j < count; j++) {
    const int64_t a = s->late + rows[j];
    double *sum = s->collected + (int64_t)rows[j] * SENT, *r = record_of(s, a);
    int32_t some[W];
    for (int l = 0; l < W; l++) some[l] = (int32_t)a;
    drift(s, some, (vec){0} + t);
    for (int part = 0; part < SENT / NR; part++)
      impulse(s, a, sum + part * NR, r[INVERSE], r + (1 + part) * NR);
    memset(sum, 0, SENT * sizeof(double));
  }
}

#if BALANCED
/* The accelerations of some nodes, or (NULL) all, change by those of nodal forces [node][NR]. */
void cb_accelerate(const world *s, const double *force, const int32_t *node, int64_t count) {
  for (int64_t i = 0; i < count; i++) {
    const int64_t a = node ? node[i] : i;
    double *r = record_of(s, a);
    impulse(s, a, force + a * NR, r[INVERSE], r + 2 * NR);
  }
}
#endif

/* A kick of some nodes by nodal forces [node][NR]. */
void cb_push(const world *s, double weight, const double *force, const int32_t *node, int64_t count) {
  for (int64_t i = 0; i < count; i++) {
    const int64_t a = node[i];
    double *r = record_of(s, a);
    impulse(s, a, force + a * NR, weight * r[INVERSE], r + NR);
  }
}

/* rates = the records' rates, [node][NR], of some nodes or all; zero for components without inertia. */
void cb_get_rates(const world *s, double *rates, const int32_t *node, int64_t count) {
  for (int64_t at = 0; at < count; at++) {
    const int64_t a = node ? node[at] : at;
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
