/* SPDX-License-Identifier: LGPL-3.0-or-later
 * The node side of local leapfrog: one coarse step's force, by a recursion over octaves of cells.
 *
 * Cells of level l act 2^l times per coarse step. Entries are the nodes that some cell of level > 0
 * touches, sorted by the finest such level, so that those whose force still changes below level l
 * are entries [first[l], count). With q the force that, held for the whole step, would have brought
 * a node to where it is (positions are x_n + softness q), entering level l is
 *   positions of the nodes of level l;  f = forces of the cells of level l there, summed over ranks;
 *   q += weight[l] (held + f) where no finer cell acts, else held and q are kept for the next level;
 * and after every second passage of level l, q = q0 + gain (q - q0) with q0 as it was at the first.
 *
 * Cells at rest are not asked for forces. Entries whose range of nodes is not stirred have never had a
 * force: their q, held and before are the zeros they were made with. Behind quiet.h; needs N, NR,
 * DIAGONAL. */

#define VN (NR < 8 ? NR : 8)
typedef double nvec __attribute__((vector_size(8 * VN)));
#define AT(p, a) ((nvec *)((p) + (int64_t)(a) * NR))
#define EACH for (int g = 0; g < NR / VN; g++)

/* What lies in a list of entries by level: those of level l and one range of nodes are a part. */
typedef struct {
  const int64_t *first;     /* parts of level l are [first[l], first[l + 1]), [levels + 2] */
  const int64_t *from;      /* [part + 1]: place in the list */
  const int64_t *range;     /* [part] */
} parts;

typedef struct {
  int64_t levels, count;
  double gain;              /* 2 gamma */
  const double *weight;     /* [levels + 1] */
  const int64_t *first;     /* [levels + 2] */
  const int64_t *slot;      /* rows of a level in held and before, [levels + 2] */
  const int32_t *node;      /* [count] */
  double *q, *still;        /* [count][NR]; still: positions at the step's own time */
  double *held, *before;    /* [slot][NR] */
  const int32_t *list;      /* entries by the level of their nodes */
  const double *softness;   /* (step^2 / 2) M^-1 per class, 0 where prescribed: [class][NR] or [N][N] */
  const double *inverse_volume;
  const int32_t *klass;     /* or NULL */
  double *x, *f;            /* [node][NR] */
  const int64_t *chunks;    /* {first, last, region, 0} of blocks, level by level */
  const int64_t *start;     /* chunks of level l are [start[l], start[l + 1]) */
  const int64_t *edge;      /* and those before edge[l] touch shared nodes */
  void (*forces)(const void *, const int64_t *, int64_t);
  const void *state;
  const int64_t *driven;    /* prescribed motion: components [driven[l], driven[l + 1]) of level l */
  const int32_t *driven_entry, *driven_component;
  const double *bend;       /* half the second difference of the motion over a step */
  double *unit;             /* q of a unit force, and at entry of each level: [levels + 2] */
  const int64_t *number;    /* of each of the chunks, among those of the activity */
  parts entries, owned;     /* of the entries, and of list */
  activity *activity;       /* or NULL */
} octaves;

/* NULL if all act. */
INLINE activity *quiet(const octaves *o) { return o->activity && o->activity->on ? o->activity : NULL; }

/* Places i in a list, of its parts of levels [l, m), but for quiet ones. */
#define EACH_OF(o, list, l, m, i)                                                                  \
  const activity *q_ = quiet(o);                                                                   \
  for (int64_t p_ = (list)->first[l]; p_ < (list)->first[m]; p_++)                                 \
    if (!q_ || q_->stirred[(list)->range[p_]])                                                     \
      for (int64_t i = (list)->from[p_]; i < (list)->from[p_ + 1]; i++)

static void act(const octaves *o, int64_t first, int64_t last) {
  activity *q = quiet(o);
  if (!q && last > first) o->forces(o->state, o->chunks + 4 * first, last - first);
  for (int64_t i = first; q && i < last; i++) {
    const int64_t c = o->number[i];
    if (q->awake[c]) o->forces(o->state, o->chunks + 4 * i, 1); else q->skipped += q->size[c];
  }
}

/* Cells of level l that what moves within the step has reached. */
static void look(const octaves *o, int64_t l) {
  activity *q = quiet(o);
  for (int64_t i = o->start[l]; q && i < o->start[l + 1]; i++) look_at(q, o->number[i], o->x, NR);
}

/* Positions of the nodes of level l, where q has brought them. */
static void place(const octaves *o, int64_t l) {
  EACH_OF(o, &o->owned, l, l + 1, i) {
    const int64_t e = o->list[i], a = o->node[e], k = o->klass ? o->klass[a] : 0;
    const double iv = o->inverse_volume[a];
#if DIAGONAL
    const nvec *q = AT(o->q, e), *x0 = AT(o->still, e), *c = AT(o->softness, k);
    nvec *x = AT(o->x, a);
    EACH x[g] = x0[g] + iv * c[g] * q[g];
#else
    const double *q = o->q + e * NR, *x0 = o->still + e * NR, *c = o->softness + k * N * N;
    double *x = o->x + a * NR;
    for (int i_ = 0; i_ < N; i_++) {
      double sum = 0;
      for (int j = 0; j < N; j++) sum += c[i_ * N + j] * q[j];
      x[i_] = x0[i_] + iv * sum;
    }
#endif
  }
  for (int64_t i = o->driven[l]; i < o->driven[l + 1]; i++) {
    const int64_t e = o->driven_entry[i], c = o->driven_component[i];
    o->x[(int64_t)o->node[e] * NR + c] = o->still[e * NR + c] + o->unit[0] * o->bend[i];
  }
  look(o, l);
}

/* Forces have come in: act on the entries that no finer level reaches, keep the others'. */
static void take(const octaves *o, int64_t l) {
  const int64_t first = o->first[l], next = o->first[l + 1];
  const double w = o->weight[l];
  const double *held = o->held + o->slot[l] * NR;
  {
    EACH_OF(o, &o->entries, l, l + 1, e) {
      nvec *f = AT(o->f, o->node[e]), *q = AT(o->q, e);
      const nvec *h = AT(held, e - first);
      EACH { q[g] += w * (h[g] + f[g]); f[g] = (nvec){0}; }
    }
  }
  if (l == o->levels) {
    o->unit[0] += w;
    return;
  }
  double *below = o->held + o->slot[l + 1] * NR, *before = o->before + o->slot[l + 1] * NR;
  EACH_OF(o, &o->entries, l + 1, o->levels + 1, e) {
    nvec *f = AT(o->f, o->node[e]), *q = AT(o->q, e);
    nvec *b = AT(below, e - next), *q0 = AT(before, e - next);
    const nvec *h = AT(held, e - first);
    EACH { b[g] = h[g] + f[g]; q0[g] = q[g]; f[g] = (nvec){0}; }
  }
  o->unit[l + 1] = o->unit[0];
}

/* Forces of the cells of level 0, at this step's own time. */
void cb_octaves_coarse(const octaves *o) { act(o, o->start[0], o->start[1]); }

/* Before the first leaf: f holds the forces of level 0 and loads, of this step's own time. */
void cb_octaves_begin(const octaves *o) {
  EACH_OF(o, &o->entries, 0, o->levels + 1, e) {
    const int64_t a = o->node[e];
    nvec *f = AT(o->f, a), *q = AT(o->q, e), *x0 = AT(o->still, e);
    nvec *h = AT(o->held, e), *q0 = AT(o->before, e);
    const nvec *x = AT(o->x, a);
    EACH { h[g] = f[g]; f[g] = q[g] = q0[g] = (nvec){0}; x0[g] = x[g]; }
  }
  o->unit[0] = o->unit[1] = 0;
}

/* Entering level l in three parts, for messages between: cells at shared nodes, the others, nodes. */
void cb_octaves_edge(const octaves *o, int64_t l, int64_t moved) {
  if (moved) place(o, l);
  act(o, o->start[l], o->edge[l]);
}

void cb_octaves_inner(const octaves *o, int64_t l) { act(o, o->edge[l], o->start[l + 1]); }

void cb_octaves_take(const octaves *o, int64_t l) { take(o, l); }

/* After every second passage of level l. */
void cb_octaves_close(const octaves *o, int64_t l) {
  const int64_t first = o->first[l];
  const double *before = o->before + o->slot[l] * NR, gain = o->gain;
  EACH_OF(o, &o->entries, l, o->levels + 1, e) {
    nvec *q = AT(o->q, e);
    const nvec *q0 = AT(before, e - first);
    EACH q[g] = q0[g] + gain * (q[g] - q0[g]);
  }
  o->unit[0] = o->unit[l] + gain * (o->unit[0] - o->unit[l]);
}

/* f = the whole step's force, positions as they were. */
void cb_octaves_end(const octaves *o) {
  EACH_OF(o, &o->entries, 0, o->levels + 1, e) {
    const int64_t a = o->node[e];
    nvec *f = AT(o->f, a), *x = AT(o->x, a);
    const nvec *q = AT(o->q, e), *x0 = AT(o->still, e);
    EACH { f[g] = q[g]; x[g] = x0[g]; }
  }
}

/* All of it, with no other rank. */
void cb_octaves(const octaves *o) {
  const int64_t L = o->levels;
  cb_octaves_begin(o);
  for (int64_t leaf = 0; leaf < (int64_t)1 << L; leaf++) {
    for (int64_t l = leaf ? L - __builtin_ctzll(leaf) : 1; l <= L; l++) {
      cb_octaves_edge(o, l, leaf);
      cb_octaves_inner(o, l);
      take(o, l);
    }
    for (int64_t l = L, done = leaf + 1; l > 0 && done % 2 == 0; l--, done /= 2) cb_octaves_close(o, l);
  }
  cb_octaves_end(o);
}

/* Messages of a level: rows of shared nodes, and the sum of all parts in the order of the ranks. */
void cb_octaves_pack(int64_t count, const int32_t *sends, const int32_t *node, const double *f,
                     double *buffer) {
  for (int64_t i = 0; i < count; i++)
    memcpy(buffer + i * NR, f + (int64_t)node[sends[i]] * NR, NR * sizeof(double));
}

void cb_octaves_add(int64_t count, const int32_t *node, const int64_t *start, const int64_t *source,
                    const double *received, double *f) {
  for (int64_t i = 0; i < count; i++) {
    double *own = f + (int64_t)node[i] * NR, sum[NR];
    memset(sum, 0, sizeof sum);
    for (int64_t j = start[i]; j < start[i + 1]; j++) {
      const double *part = source[j] < 0 ? own : received + source[j] * NR;
      for (int c = 0; c < NR; c++) sum[c] += part[c];
    }
    memcpy(own, sum, sizeof sum);
  }
}
