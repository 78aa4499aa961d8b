/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Exact schedules: cell K acts at j h_K, j = 0, 1, ..., with h_K any real number. Behind events.h and
 * the regions' lone functions; needs LONE(region, ...), PACKED.
 *
 * A span's events are put in order of time once (ties by the cells' global numbers). Each then waits
 * only for the events before it on its own nodes: those that wait for nothing lie on a stack, share
 * no node, and act W at a time; last in, first out keeps to cells whose data is at hand. Another
 * rank's event is a *visit* to each shared node it touches: it waits for its kick to come in, too. So
 * every node sees all its events in the one order, whatever the number of ranks. */

#define SLOTS (DIM + 1)
#define STEP (GEOMETRY + COEFFICIENTS) /* in a packed cell: geometry, coefficients, h_K, nodes */

typedef struct {
  int64_t cells, visits;    /* slots of cells (padding included), visits by other ranks' cells */
  const double *packed;     /* [cell][PACKED] */
  const int32_t *region;    /* [cell] */
  const double *step;       /* [cell + visit], infinite for padding */
  int64_t *counter;         /* [cell + visit]: the next event's j */
  const int64_t *number;    /* [cell + visit]: global number of the cell */
  const int32_t *row;       /* [visit]: row of the receive table, node and neighbour */
  const int32_t *row_node;  /* [row]: node */
  double *time;             /* a span's events in their order: [event] */
  int32_t *who, *next, *link; /* cell or visit; [event][SLOTS] who waits for it; next visit of a row */
  uint8_t *waits;           /* [event]: for so many others, and for a kick to come in */
  int32_t *last;            /* [node]: last event so far and its slot */
  int32_t *stack;           /* [event] */
  int32_t *bucket;          /* [buckets + 1] */
  int64_t buckets;
  int32_t *head, *tail;     /* [row]: visits whose kicks have yet to come */
  double *kicks;            /* [event][N] of visits */
  const int32_t *rows_of, *rows; /* rows of a shared node: rows[rows_of[p] .. rows_of[p + 1]) */
  const int32_t *row_neighbour, *row_place;
  double *outgoing;         /* [row order by neighbour][1 + N]: place among the pair's nodes, kick */
  const int64_t *out_start; /* [neighbour]: where its kicks start, in kicks */
  int64_t *out_count;       /* [neighbour] */
  int64_t first_shared, last_shared;
  int64_t events, top, done;
  int32_t trapezoidal;
} schedule;

static const int32_t *nodes_of(const schedule *x, int64_t cell) {
  return (const int32_t *)(x->packed + cell * PACKED + STEP + 1);
}

static int before(const schedule *x, double t, int32_t a, double u, int32_t b) {
  return t < u || (t == u && x->number[a] < x->number[b]);
}

/* Events with t0 <= t < t1 in the order of time. */
static void in_order(schedule *x, double t0, double t1) {
  const int64_t all = x->cells + x->visits;
  const double scale = x->buckets / (t1 - t0);
  memset(x->bucket, 0, (x->buckets + 1) * sizeof(int32_t));
#define BUCKET(t) ({ int64_t b_ = (int64_t)(((t) - t0) * scale);                                    \
                     b_ < 0 ? 0 : b_ >= x->buckets ? x->buckets - 1 : b_; })
  for (int64_t i = 0; i < all; i++) {
    const double h = x->step[i];
    for (int64_t j = x->counter[i]; j * h < t1; j++) x->bucket[BUCKET(j * h) + 1]++;
  }
  for (int64_t b = 0; b < x->buckets; b++) x->bucket[b + 1] += x->bucket[b];
  x->events = x->bucket[x->buckets];
  for (int64_t i = 0; i < all; i++) {
    const double h = x->step[i];
    int64_t j = x->counter[i];
    for (; j * h < t1; j++) {
      const int32_t at = x->bucket[BUCKET(j * h)]++;
      x->time[at] = j * h;
      x->who[at] = (int32_t)i;
    }
    x->counter[i] = j;
  }
  for (int64_t e = 1; e < x->events; e++) { /* nearly sorted by now */
    const double t = x->time[e];
    const int32_t w = x->who[e];
    int64_t f = e;
    for (; f > 0 && before(x, t, w, x->time[f - 1], x->who[f - 1]); f--) {
      x->time[f] = x->time[f - 1];
      x->who[f] = x->who[f - 1];
    }
    x->time[f] = t;
    x->who[f] = w;
  }
}

/* Event e acts on a node behind the last one there, and waits for it. */
INLINE void follow(schedule *x, int32_t node, int32_t e, int slot, int *waits) {
  const int32_t p = x->last[node];
  if (p >= 0) {
    x->next[p] = e;
    ++*waits;
  }
  x->last[node] = e * SLOTS + slot;
}

/* Schedule the span [t0, t1): returns the number of its events. */
int64_t cb_exact_schedule(const world *s, schedule *x, double t0, double t1, int64_t rows) {
  in_order(x, t0, t1);
  for (int64_t a = 0; a <= s->nodes; a++) x->last[a] = -1;
  for (int64_t r = 0; r < rows; r++) x->head[r] = x->tail[r] = -1;
  memset(x->next, -1, x->events * SLOTS * sizeof(int32_t));
  x->top = x->done = 0;
  for (int32_t e = 0; e < x->events; e++) {
    const int32_t w = x->who[e];
    int waits = 0;
    if (w < x->cells) {
      const int32_t *c = nodes_of(x, w);
      for (int a = 0; a <= DIM; a++) follow(x, c[a], e, a, &waits);
    } else {
      const int32_t row = x->row[w - x->cells];
      follow(x, x->row_node[row], e, 0, &waits);
      waits++;
      x->link[e] = -1;
      if (x->tail[row] < 0) x->head[row] = e; else x->link[x->tail[row]] = e;
      x->tail[row] = e;
    }
    x->waits[e] = (uint8_t)waits;
  }
  for (int64_t e = x->events - 1; e >= 0; e--) /* the earliest on top */
    if (!x->waits[e]) x->stack[x->top++] = (int32_t)e;
  return x->events;
}

/* Event e waits for one less; visits are done at once. */
static void release(const world *s, schedule *x, int32_t e) {
  while (e >= 0 && --x->waits[e] == 0) {
    const int32_t w = x->who[e];
    if (w < x->cells) {
      x->stack[x->top++] = e;
      return;
    }
    const int64_t a = x->row_node[x->row[w - x->cells]];
    double *r = record_of(s, a);
    int32_t some[W];
    for (int l = 0; l < W; l++) some[l] = (int32_t)a;
    drift(s, some, (vec){0} + x->time[e]);
    impulse(s, a, x->kicks + (int64_t)e * N, r[INVERSE], r + NR);
    x->done++;
    e = x->next[(int64_t)e * SLOTS];
  }
}

/* Kicks of shared nodes, for all ranks that have them. */
static void emit(const schedule *x, const int32_t *c, const vec weight, const vec f[NR], int count) {
  for (int l = 0; l < count; l++) {
    const int64_t a = c[l];
    if (a < x->first_shared || a >= x->last_shared) continue;
    const int64_t p = a - x->first_shared;
    for (int32_t i = x->rows_of[p]; i < x->rows_of[p + 1]; i++) {
      const int32_t q = x->row_neighbour[x->rows[i]];
      double *to = x->outgoing + (x->out_start[q] + x->out_count[q]++) * (1 + N);
      to[0] = x->row_place[x->rows[i]];
      for (int j = 0; j < N; j++) to[1 + j] = weight[l] * f[j][l];
    }
  }
}

/* `count` events of one region that share no node act. */
static void act_alone(const world *s, schedule *x, const int32_t *event, int count) {
  vec b[PACKED], out[DIM + 1][NR], t, weight;
  int32_t c[SLOTS * W], cell[W];
  const double *row[W];
  for (int l = 0; l < W; l++) {
    const int32_t e = event[l < count ? l : 0];
    cell[l] = x->who[e];
    row[l] = x->packed + (int64_t)cell[l] * PACKED;
    t[l] = x->time[e];
    const int32_t *node = (const int32_t *)(row[l] + STEP + 1);
    for (int a = 0; a <= DIM; a++) c[a * W + l] = l < count ? node[a] : (int32_t)s->nodes;
  }
  for (int g = 0; g < PACKED; g += W) {
    vec r[W];
    for (int l = 0; l < W; l++) r[l] = *(const vec_u *)(row[l] + g);
    transpose(r);
    for (int i = 0; i < W; i++) b[g + i] = r[i];
  }
  const vec h = b[STEP];
  weight = h;
  for (int l = 0; l < W; l++) {
    if (x->trapezoidal && t[l] == 0) weight[l] *= 0.5;
    if (l >= count) weight[l] = 0;
  }
  LONE(x->region[cell[0]], s, c, cell, b, b + GEOMETRY, t, h * h / 12.0, count, out);
  for (int a = 0; a <= DIM; a++) kick(s, c + a * W, weight, out[a]);
  if (x->last_shared > x->first_shared)
    for (int a = 0; a <= DIM; a++) emit(x, c + a * W, weight, out[a], count);
  for (int l = 0; l < count; l++)
    for (int a = 0; a <= DIM; a++) release(s, x, x->next[(int64_t)event[l] * SLOTS + a]);
  x->done += count;
}

/* Do all events that wait for nothing. */
void cb_exact_go(const world *s, schedule *x) {
  while (x->top > 0) {
    int32_t some[W];
    int count = 1;
    some[0] = x->stack[--x->top];
    const int32_t region = x->region[x->who[some[0]]];
    while (count < W && x->top > 0 && x->region[x->who[x->stack[x->top - 1]]] == region)
      some[count++] = x->stack[--x->top];
    act_alone(s, x, some, count);
  }
}

/* Kicks that a neighbour, whose rows start at `first`, has sent. */
void cb_exact_deliver(const world *s, schedule *x, int64_t first, const double *message,
                      int64_t count) {
  for (int64_t i = 0; i < count; i++, message += 1 + N) {
    const int64_t row = first + (int64_t)message[0];
    const int32_t e = x->head[row];
    x->head[row] = x->link[e];
    memcpy(x->kicks + (int64_t)e * N, message + 1, N * sizeof(double));
    release(s, x, e);
  }
}

/* Kicks that bring every cell's impulse to time t: cells have given it up to half a step behind their
 * last event (trapezoidal), or up to the next one. On a copy of the records: the schedule goes on. */
void cb_exact_complete(const world *s, const schedule *x, int64_t blocks, double t) {
  for (int64_t m = 0; m < blocks; m++) {
    const vec *b = (const vec *)(s->geometry + m * GEOMETRY * W);
    const vec *k = (const vec *)(s->coefficient + m * COEFFICIENTS * W);
    const int32_t *c = s->cell + m * SLOTS * W;
    vec out[DIM + 1][NR], weight = {0};
    int32_t cell[W];
    int count = 0;
    for (int l = 0; l < W; l++) {
      cell[l] = (int32_t)(m * W + l);
      const double h = x->step[cell[l]];
      const int64_t j = x->counter[cell[l]];
      if (c[l] >= s->nodes) continue;
      count = l + 1;
      if (j > 0) weight[l] = x->trapezoidal ? t - (j - 0.5) * h : t - j * h;
    }
    LONE(x->region[m * W], s, c, cell, b, k, (vec){0} + t, (vec){0}, count, out);
    for (int a = 0; a <= DIM; a++) kick(s, c + a * W, weight, out[a]);
  }
}

/* Nodes that loads or moving supports act on, at t. */
void cb_exact_touch(const world *s, const int32_t *node, int64_t count, double t) {
  for (int64_t i = 0; i < count; i++) {
    int32_t some[W];
    for (int l = 0; l < W; l++) some[l] = node[i];
    drift(s, some, (vec){0} + t);
  }
}
