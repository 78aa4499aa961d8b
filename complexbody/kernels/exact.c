/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Exact schedules: cell K acts at j h_K, j = 0, 1, ..., with h_K any real number. Behind events.h and
 * the regions' lone functions; needs LONE(region, ...), PACKED.
 *
 * A span's events are put in order of time once (ties by the cells' ranks and global numbers). Each then waits
 * only for the events before it on its own nodes: those that wait for nothing lie on a stack, share
 * no node, and act W at a time; last in, first out keeps to cells whose data is at hand. Another
 * rank's event is a *visit* to each shared node it touches: it waits for its kick to come in, too. So
 * every node sees all its events in the one order, whatever the number of ranks. */

#include <stdlib.h>

#define SLOTS (DIM + 1)
#define STEP (GEOMETRY + COEFFICIENTS) /* a packed cell: geometry, coefficients, h_K, nodes, alone */

typedef struct { double time; int32_t index, actor; } entry; /* not yet known who waits for whom */
typedef struct {
  double time;
  int32_t actor, waits;    /* cell, or cells + visit; for so many others, and for a kick to come in */
  int32_t next[SLOTS];     /* who waits for it at each of its nodes, or one that waits for ever */
} event;

typedef struct {
  int64_t cells, visits;    /* slots of cells (padding included), visits by other ranks' cells */
  const double *packed;     /* [cell][PACKED] */
  const int32_t *node;      /* [cell][SLOTS]: once more, close together */
  const int32_t *region;    /* [cell] */
  const double *step;       /* of cells and visits by rank and global number: [index] */
  int64_t *counter;         /* [index]: the next event's j */
  double *due;              /* [index]: its time, infinite for padding and quiet cells */
  const int32_t *actor;     /* [index]: cell, or cells + visit */
  const int32_t *index;     /* [cell] */
  const int32_t *row;       /* [visit]: row of the receive table, node and neighbour */
  const int32_t *row_node;  /* [row]: node */
  entry *list;              /* a span's events in their order */
  event *event;
  int32_t *link;            /* [event]: next visit of a row */
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

#define CROWD 24 /* events of a bucket of time that are too many for insertion */
#define AHEAD 12 /* events whose data is fetched while earlier ones are worked on */

/* By time; of two at one time the one of the smaller index. */
static int by_time(const void *a, const void *b) {
  const entry *e = a, *f = b;
  return e->time < f->time ? -1 : e->time > f->time ? 1 : (e->index > f->index) - (e->index < f->index);
}

/* Events with t0 <= t < t1 in their order: into buckets of time, then bucket by bucket. */
static void in_order(schedule *x, double t0, double t1) {
  const int64_t all = x->cells + x->visits;
  const double scale = x->buckets / (t1 - t0);
  memset(x->bucket, 0, (x->buckets + 1) * sizeof(int32_t));
#define BUCKET(t) ({ int64_t b_ = (int64_t)(((t) - t0) * scale);                                    \
                     b_ < 0 ? 0 : b_ >= x->buckets ? x->buckets - 1 : b_; })
  for (int64_t i = 0; i < all; i++) {
    if (x->due[i] >= t1) continue;
    const double h = x->step[i];
    for (int64_t j = x->counter[i]; j * h < t1; j++) x->bucket[BUCKET(j * h) + 1]++;
  }
  int crowded = 0;
  for (int64_t b = 0; b < x->buckets; b++) {
    crowded |= x->bucket[b + 1] > CROWD;
    x->bucket[b + 1] += x->bucket[b];
  }
  x->events = x->bucket[x->buckets];
  for (int64_t i = 0; i < all; i++) {
    if (x->due[i] >= t1) continue;
    const double h = x->step[i];
    int64_t j = x->counter[i];
    for (; j * h < t1; j++)
      x->list[x->bucket[BUCKET(j * h)]++] = (entry){j * h, (int32_t)i, x->actor[i]};
    x->counter[i] = j;
    x->due[i] = j * h;
  }
  for (int64_t b = 0, first = 0; crowded && b < x->buckets; first = x->bucket[b++]) {
    entry *e = x->list + first;
    const int64_t count = x->bucket[b] - first;
    int64_t sorted = 1; /* meshes of equal cells give crowds of equal times, in order already */
    if (count <= CROWD) continue;
    while (sorted < count && e[sorted - 1].time <= e[sorted].time) sorted++;
    if (sorted < count) qsort(e, count, sizeof(entry), by_time);
  }
  for (int64_t e = 1; e < x->events; e++) { /* nearly sorted by now; equal times stay as they are */
    const entry moved = x->list[e];
    int64_t f = e;
    for (; f > 0 && x->list[f - 1].time > moved.time; f--) x->list[f] = x->list[f - 1];
    if (f < e) x->list[f] = moved;
  }
}

/* Event e acts on a node behind the last one there, and waits for it. */
INLINE void follow(schedule *x, int32_t node, int32_t e, int slot) {
  const int32_t p = x->last[node];
  if (p >= 0) {
    x->event[p / SLOTS].next[p % SLOTS] = e;
    x->event[e].waits++;
  }
  x->last[node] = e * SLOTS + slot;
}

/* Schedule the span [t0, t1): returns the number of its events. */
int64_t cb_exact_schedule(const world *s, schedule *x, double t0, double t1, int64_t rows) {
  in_order(x, t0, t1);
  for (int64_t a = 0; a <= s->nodes; a++) x->last[a] = -1;
  for (int64_t r = 0; r < rows; r++) x->head[r] = x->tail[r] = -1;
  x->top = x->done = 0;
  for (int32_t e = 0; e < x->events; e++) {
    const int32_t w = x->list[e].actor;
    if (e + 2 * AHEAD < x->events) {
      const int32_t far = x->list[e + 2 * AHEAD].actor, v = x->list[e + AHEAD].actor;
      if (far < x->cells) __builtin_prefetch(x->node + (int64_t)far * SLOTS);
      if (v < x->cells)
        for (int a = 0; a <= DIM; a++) __builtin_prefetch(x->last + x->node[(int64_t)v * SLOTS + a], 1);
    }
    event *now = x->event + e;
    *now = (event){x->list[e].time, w, 0, {0}};
    for (int a = 0; a <= DIM; a++) now->next[a] = (int32_t)x->events;
    if (w < x->cells) {
      const int32_t *c = x->node + (int64_t)w * SLOTS;
      for (int a = 0; a <= DIM; a++) follow(x, c[a], e, a);
    } else {
      const int32_t row = x->row[w - x->cells];
      follow(x, x->row_node[row], e, 0);
      now->waits++;
      x->link[e] = -1;
      if (x->tail[row] < 0) x->head[row] = e; else x->link[x->tail[row]] = e;
      x->tail[row] = e;
    }
  }
  x->event[x->events].waits = INT32_MAX;
  for (int64_t e = x->events - 1; e >= 0; e--) /* the earliest on top */
    if (!x->event[e].waits) x->stack[x->top++] = (int32_t)e;
  return x->events;
}

/* Event e waits for one less; visits are done at once. */
static void release(const world *s, schedule *x, int32_t e) {
  while (--x->event[e].waits == 0) {
    const int32_t w = x->event[e].actor;
    if (w < x->cells) {
      x->stack[x->top++] = e;
      return;
    }
    const int64_t a = x->row_node[x->row[w - x->cells]];
    double *r = record_of(s, a);
    int32_t some[W];
    for (int l = 0; l < W; l++) some[l] = (int32_t)a;
    drift(s, some, (vec){0} + x->event[e].time);
    impulse(s, a, x->kicks + (int64_t)e * N, r[INVERSE], r + NR);
    x->done++;
    e = x->event[e].next[0];
  }
}

/* All that wait for an event wait for one less. Without visits there is nothing to branch for. */
INLINE void release_all(const world *s, schedule *x, const event *e) {
  for (int a = 0; a <= DIM; a++) {
    if (x->visits) {
      release(s, x, e->next[a]);
    } else {
      x->stack[x->top] = e->next[a];
      x->top += --x->event[e->next[a]].waits == 0;
    }
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
static void act_alone(const world *s, schedule *x, const int32_t *which, int count) {
  vec b[PACKED], out[DIM + 1][NR], t, weight, alone;
  int32_t c[SLOTS * W], cell[W];
  const double *row[W];
  for (int l = 0; l < W; l++) {
    const event *e = x->event + which[l < count ? l : 0];
    cell[l] = e->actor;
    row[l] = x->packed + (int64_t)cell[l] * PACKED;
    t[l] = e->time;
    const int32_t *node = (const int32_t *)(row[l] + STEP + 1);
    for (int a = 0; a <= DIM; a++) c[a * W + l] = l < count ? node[a] : (int32_t)s->nodes;
    alone[l] = *(const float *)(node + SLOTS);
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
  LONE(x->region[cell[0]], s, c, cell, b, b + GEOMETRY, t, alone * h * h / 12.0, count, out);
  for (int a = 0; a <= DIM; a++) kick(s, c + a * W, weight, out[a]);
  if (x->last_shared > x->first_shared)
    for (int a = 0; a <= DIM; a++) emit(x, c + a * W, weight, out[a], count);
  for (int l = 0; l < count; l++) release_all(s, x, x->event + which[l]);
  x->done += count;
}

typedef struct { int count; int32_t which[W]; } lot;

/* Up to W events of one region that wait for nothing: their cells' data is sent for. */
static void take(schedule *x, lot *l) {
#define REGION(e) x->region[x->event[e].actor]
  l->count = 0;
  while (l->count < W && x->top > 0) {
    const int32_t e = x->stack[x->top - 1], w = x->event[e].actor;
    if (l->count && x->region[w] != REGION(l->which[0])) break;
    l->which[l->count++] = e;
    x->top--;
    for (int i = 0; i < PACKED; i += 8) __builtin_prefetch(x->packed + (int64_t)w * PACKED + i);
    for (int a = 0; a <= DIM; a++) __builtin_prefetch(x->event + x->event[e].next[a], 1);
  }
}

/* Their nodes' records are sent for. */
static void fetch(const world *s, const schedule *x, const lot *l) {
  for (int i = 0; i < l->count; i++) {
    const double *row = x->packed + (int64_t)x->event[l->which[i]].actor * PACKED;
    const int32_t *c = (const int32_t *)(row + STEP + 1);
    for (int a = 0; a <= DIM; a++)
      for (int j = 0; j < RECORD; j += 8) __builtin_prefetch(record_of(s, c[a]) + j, 1);
  }
}

/* Do all events that wait for nothing, two lots on their way while one acts: their data has time to
 * come. Events that wait for nothing share no node, so they may be taken before others act. */
void cb_exact_go(const world *s, schedule *x) {
  lot lots[3];
  take(x, lots);
  fetch(s, x, lots);
  take(x, lots + 1);
  for (int i = 0; lots[i].count > 0; i = (i + 1) % 3) {
    lot *next = lots + (i + 1) % 3, *after = lots + (i + 2) % 3;
    fetch(s, x, next);
    take(x, after);
    act_alone(s, x, lots[i].which, lots[i].count);
    if (!next->count && after->count) { /* none may stand behind an empty lot */
      *next = *after;
      after->count = 0;
    }
    if (!next->count) take(x, next);
    if (next->count && !after->count) take(x, after);
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
    int count = 0, due = 0;
    for (int l = 0; l < W; l++) {
      cell[l] = (int32_t)(m * W + l);
      const int32_t i = x->index[cell[l]];
      const double h = x->step[i];
      const int64_t j = x->counter[i];
      if (c[l] >= s->nodes) continue;
      count = l + 1;
      due |= x->due[i] < INFINITY;
      if (j > 0) weight[l] = x->trapezoidal ? t - (j - 0.5) * h : t - j * h;
    }
    if (!due) continue; /* cells that are quiet */
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
