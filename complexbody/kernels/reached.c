/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Quiet cells of an exact schedule: those whose nodes nothing can have moved are not scheduled.
 *
 * Before a span it is followed from node to node when motion can get there: a node moves from the first
 * event of one of its cells that has moving nodes, and moves the others of this cell only at an event
 * strictly behind that (an event at the same time still finds them at zero). A cell is `awake` as soon
 * as one of its nodes moves before the span's end: it is scheduled then, with the next of its events.
 * All events left out would have found nodes at zero, and nothing to do. Behind exact.c. */

typedef struct {
  int64_t cells, nodes, awake_cells, skipped; /* slots of cells; awake ones; events of these left out before */
  const int64_t *cell_from; /* the cells of each node, [node + 1] */
  const int32_t *cell;
  double *since;            /* [node]: when it begins to move, infinite if nothing is known to move it */
  double *first;            /* [cell]: its first event that moves something, infinite so far */
  uint8_t *awake, *queued;  /* [cell] */
  int32_t *queue;           /* [cells], a ring */
  int64_t head, waiting;
  int32_t *idle;            /* awake cells that have not moved anything, [cells] */
  int64_t idles;
} reached;

/* The first j with j h >= t, exactly as a schedule counts. */
static int64_t next_event(double h, double t) {
  int64_t j = (int64_t)(t / h) - 1;
  if (j < 0) j = 0;
  while (j * h < t) j++;
  return j;
}

static void put(reached *r, int32_t k) {
  if (r->queued[k]) return;
  r->queued[k] = 1;
  int64_t at = r->head + r->waiting++;
  r->queue[at < r->cells ? at : at - r->cells] = k;
}

static void rouse(schedule *x, reached *r, int32_t k, double t) {
  if (r->awake[k]) return;
  const int32_t i = x->index[k];
  r->awake[k] = 1;
  r->awake_cells++;
  r->idle[r->idles++] = k;
  x->counter[i] = next_event(x->step[i], t);
  x->due[i] = x->counter[i] * x->step[i];
  r->skipped += x->counter[i];
}

/* Node a moves from t on. */
static void begins(reached *r, int64_t a, double t) {
  if (r->since[a] <= t) return;
  r->since[a] = t;
  for (int64_t i = r->cell_from[a]; i < r->cell_from[a + 1]; i++) put(r, r->cell[i]);
}

/* At the start: some cells are awake at any rate; nodes that move, from whenever. */
void cb_reached_rouse(schedule *x, reached *r, const int32_t *cell, int64_t count, double t) {
  for (int64_t i = 0; i < count; i++) rouse(x, r, cell[i], t);
}

/* Some nodes move from t[i] on; returns whether any of this was not known. */
int64_t cb_reached_begin(reached *r, const int32_t *node, const double *t, int64_t count) {
  int64_t news = 0;
  for (int64_t i = 0; i < count; i++) {
    news |= t[i] < r->since[node[i]];
    begins(r, node[i], t[i]);
  }
  return news;
}

/* Follow motion through the span [t0, t1), which has yet to be scheduled. */
void cb_reached_follow(schedule *x, reached *r, double t0, double t1) {
  for (int64_t i = 0; i < r->idles; i++) put(r, r->idle[i]);
  while (r->waiting) {
    const int32_t k = r->queue[r->head];
    const int32_t *c = x->node + (int64_t)k * SLOTS;
    double from = INFINITY;
    if (++r->head == r->cells) r->head = 0;
    r->waiting--;
    r->queued[k] = 0;
    for (int a = 0; a <= DIM; a++) from = fmin(from, r->since[c[a]]);
    if (from >= t1) continue;
    rouse(x, r, k, t0);
    const double h = x->step[x->index[k]];
    int64_t j = x->counter[x->index[k]];
    if (j * h <= from) {
      j = next_event(h, from);
      j += j * h <= from;
    }
    const double t = j * h;
    if (t >= t1 || t >= r->first[k]) continue;
    r->first[k] = t;
    for (int a = 0; a <= DIM; a++) begins(r, c[a], t);
  }
  int64_t idles = 0;
  for (int64_t i = 0; i < r->idles; i++)
    if (r->first[r->idle[i]] == INFINITY) r->idle[idles++] = r->idle[i];
  r->idles = idles;
}

/* All cells are awake from t on. */
void cb_reached_all(schedule *x, reached *r, double t) {
  for (int32_t k = 0; k < r->cells; k++)
    if (x->node[(int64_t)k * SLOTS] < r->nodes) rouse(x, r, k, t);
}

/* Events before t that were left out so far. */
int64_t cb_reached_skipped(const schedule *x, const reached *r, double t) {
  int64_t skipped = r->skipped;
  for (int32_t k = 0; k < r->cells; k++)
    if (!r->awake[k] && x->node[(int64_t)k * SLOTS] < r->nodes)
      skipped += next_event(x->step[x->index[k]], t);
  return skipped;
}
