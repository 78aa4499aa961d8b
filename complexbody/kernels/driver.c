/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Loops over blocks of cells and over nodes: forces, energies, and the synchronous step.
 *
 * Assembled behind vectors.h, quiet.h and the regions' functions; needs N, NU, NR, DIM, GEOMETRY,
 * COEFFICIENTS, DIAGONAL, DAMPED, COUPLED (where the block of a node begins that inertia or damping
 * couples), FORCE(region, ...), ENERGY(region, ...), RESTLESS(region, ...).
 *
 * One step (kick, drift) with effective mass Mh and damping D, from the discrete principle:
 *   (Mh + hD/2) v+ = (Mh - hD/2) v- + h f,   x += h v+
 * v is the mean rate of the last drift. alpha = (Mh + hD/2)^-1 (Mh - hD/2) and beta =
 * h (Mh + hD/2)^-1 are per unit volume and per class of nodes. */

typedef struct { int64_t first, last, region, nodes; } chunk; /* blocks [first, last), then nodes below */

typedef struct {
  int64_t nodes, interior, chunks, boundary_chunks;
  double step;
  const chunk *table;             /* chunks; the first boundary_chunks touch shared nodes */
  const int32_t *cell;            /* [block][vertex][lane] */
  const double *geometry;         /* [block][GEOMETRY][lane] */
  const double *coefficient;      /* [block][COEFFICIENTS][lane] */
  double *x, *v, *f;              /* [node][NR] */
  const double *constant;         /* force that never changes, [node][NR], or NULL */
  const double *volume, *inverse_volume; /* lumped, [node] */
  const int32_t *klass;           /* class of a node, or NULL if there is one class */
  const double *alpha, *beta;     /* DIAGONAL: [class][NR]; else [class][N][N] */
  const double *eta;              /* damping per volume, same shape */
  double *sums;                   /* dissipated, variation of u_dot, of nu_dot */
  const double *coordinates;      /* [node][3], for tabulated kernels */
  const uint8_t *counted;         /* 1 where this rank counts the node in sums, [node] */
  const tabulated *forms;         /* [region]{force, stored, potential energy}, where FFCx made them */
  activity *activity;             /* of chunks, and of the nodes each finishes; or NULL */
  const uint8_t *plain;       /* unless DIAGONAL: [class] 1 where the matrices are; or NULL */
} state;

#define VN (NR < 8 ? NR : 8) /* components of one node vector */
typedef double nvec __attribute__((vector_size(8 * VN)));
typedef long long nivec __attribute__((vector_size(8 * VN)));
#define AT(p, a) ((nvec *)((p) + (int64_t)(a) * NR))

INLINE nvec nabs(nvec a) { return (nvec)((nivec)a & 0x7fffffffffffffffLL); }

/* Whatever may be skipped is not inlined: the same instructions do it whether or not others are. */
#define APART __attribute__((noinline))

/* NULL if all act. */
INLINE activity *quiet(const state *s) { return s->activity && s->activity->on ? s->activity : NULL; }

static APART void force_chunk(const state *s, const chunk *t) {
  if (t->last > t->first)
    FORCE(t->region, t->last - t->first, t->first, s->cell + t->first * (DIM + 1) * W,
          s->geometry + t->first * GEOMETRY * W, s->coefficient + t->first * COEFFICIENTS * W, s);
}

/* Kick and drift the nodes [first, last) and make f ready for the next step. Sums: dissipated
 * work h/4 (v+ + v-) D (v+ + v-), and the variation of the rates, the integral of |v+ - v-|_1. */
static APART void update(const state *s, int64_t first, int64_t last) {
  const double h = s->step;
  nvec variation[NR / VN] = {{0}}, lost[NR / VN] = {{0}};
  for (int64_t a = first; a < last; a++) {
    const int64_t k = s->klass ? s->klass[a] : 0;
    const double iv = s->inverse_volume[a], vol = s->counted[a] ? s->volume[a] : 0.0;
    nvec *x = AT(s->x, a), *v = AT(s->v, a), *f = AT(s->f, a);
#if DIAGONAL
    const nvec *al = AT(s->alpha, k), *be = AT(s->beta, k);
#else
    const double *al = s->alpha + k * N * N, *be = s->beta + k * N * N;
    double now[NR] = {0};
    const double *vo = (const double *)v, *fo = (const double *)f;
    const int coupled = s->plain && s->plain[k] ? N : COUPLED;
    for (int i = 0; i < coupled; i++) now[i] = al[i * N + i] * vo[i] + be[i * N + i] * iv * fo[i];
    for (int i = coupled; i < N; i++) {
      double sum = 0;
      for (int j = COUPLED; j < N; j++) sum += al[i * N + j] * vo[j] + be[i * N + j] * iv * fo[j];
      now[i] = sum;
    }
#if DAMPED
    if (s->plain && s->plain[k])
      for (int i = 0; i < N; i++) {
        const double both = vo[i] + now[i];
        lost[0][0] += vol * s->eta[(k * N + i) * N + i] * both * both;
      }
    for (int i = coupled; i < N; i++)
      for (int j = COUPLED; j < N; j++)
        lost[0][0] += vol * s->eta[k * N * N + i * N + j] * (vo[i] + now[i]) * (vo[j] + now[j]);
#endif
#endif
    for (int g = 0; g < NR / VN; g++) {
#if DIAGONAL
      const nvec old = v[g], new = al[g] * old + be[g] * iv * f[g];
#if DAMPED
      const nvec both = old + new;
      lost[g] += vol * AT(s->eta, k)[g] * both * both;
#endif
#else
      nvec new; memcpy(&new, now + g * VN, sizeof new);
      const nvec old = v[g];
#endif
      variation[g] += vol * nabs(new - old);
      x[g] += h * new;
      v[g] = new;
      f[g] = s->constant ? AT(s->constant, a)[g] : (nvec){0};
    }
  }
  const double *tv = (const double *)variation, *l = (const double *)lost;
  for (int i = 0; i < NR; i++) {
    s->sums[0] += 0.25 * h * l[i];
    if (i < N) s->sums[i < NU ? 1 : 2] += tv[i];
  }
}

/* The nodes that chunk c finishes: [first_node(c), s->table[c].nodes). */
INLINE int64_t first_node(const state *s, int64_t c) { return c ? s->table[c - 1].nodes : 0; }

/* Forces of chunks [first, last) and, if `move`, kick and drift of the nodes no later cell touches. */
static void act(const state *s, int64_t first, int64_t last, int move) {
  activity *q = quiet(s);
  for (int64_t c = first; c < last; c++) {
    if (!q || q->awake[c]) force_chunk(s, s->table + c); else q->skipped += q->size[c];
    if (move && (!q || q->stirred[c])) update(s, first_node(s, c), s->table[c].nodes);
  }
}

/* Chunks whose cells touch nodes shared with other ranks, with the nodes complete after them. */
void cb_boundary_forces(const state *s) { act(s, 0, s->boundary_chunks, 1); }

void cb_interior_step(const state *s) { act(s, s->boundary_chunks, s->chunks, 1); }

/* Kick and drift by forces that are there: nodes that cells finish, or those behind them. */
void cb_update(const state *s) {
  activity *q = quiet(s);
  for (int64_t c = 0; c < s->chunks; c++)
    if (!q || q->stirred[c]) update(s, first_node(s, c), s->table[c].nodes);
}

void cb_update_late(const state *s) { update(s, s->interior, s->nodes); }

/* All forces on top of what f holds, nodes untouched. */
void cb_forces(const state *s) { act(s, 0, s->chunks, 0); }

/* After a step: chunks that the motion has reached. Forces depend on positions alone. */
void cb_look(const state *s) {
  activity *q = quiet(s);
  for (int64_t c = 0; q && c < q->chunks; c++) look_at(q, c, s->x, NR);
}

/* Where cells have forces (by chunk) or energies even at x = 0, which s->x must be. */
void cb_restless(const state *s, uint8_t *force, uint8_t *energy) {
  for (int64_t c = 0; c < s->chunks; c++) {
    const chunk *t = s->table + c;
    RESTLESS(t->region, t->last - t->first, t->first, s->cell + t->first * (DIM + 1) * W, s,
             force + c, energy)
  }
}

/* Forces of some chunks of cells only, on top of what f holds. */
void cb_forces_of(const state *s, const chunk *table, int64_t count) {
  for (int64_t c = 0; c < count; c++) force_chunk(s, table + c);
}

/* Loads: f += amplitude[group] * value at flat positions; returns their power on the rates v. */
void cb_add_loads(int64_t count, const int64_t *position, const int32_t *group, const double *value,
                  const double *amplitude, double *f) {
  for (int64_t i = 0; i < count; i++) f[position[i]] += amplitude[group[i]] * value[i];
}

double cb_power(int64_t count, const int64_t *position, const int32_t *group, const double *value,
                const double *amplitude, const double *v) {
  double sum = 0;
  for (int64_t i = 0; i < count; i++) sum += amplitude[group[i]] * value[i] * v[position[i]];
  return sum;
}

/* Many steps with no other rank: amplitudes [steps][groups]; external work into sums[3]. */
void cb_steps(const state *s, int64_t steps, int64_t count, const int64_t *position,
              const int32_t *group, const double *value, const double *amplitude, int64_t groups) {
  for (int64_t i = 0; i < steps; i++) {
    const double *a = amplitude + i * groups;
    cb_add_loads(count, position, group, value, a, s->f);
    s->sums[3] += 0.5 * s->step * cb_power(count, position, group, value, a, s->v);
    act(s, 0, s->chunks, 1);
    cb_look(s);
    s->sums[3] += 0.5 * s->step * cb_power(count, position, group, value, a, s->v);
  }
}

/* Shared nodes: gather what others need, and sum partial forces in the order of the ranks. */
void cb_pack(int64_t count, const int32_t *node, const double *f, double *buffer) {
  for (int64_t i = 0; i < count; i++)
    memcpy(buffer + i * NR, f + (int64_t)node[i] * NR, NR * sizeof(double));
}

void cb_sum_shared(int64_t count, int64_t first, const int64_t *start, const int64_t *source,
                   const double *received, double *f) {
  for (int64_t i = 0; i < count; i++) {
    double *own = f + (first + i) * NR, sum[NR] = {0};
    for (int64_t j = start[i]; j < start[i + 1]; j++) {
      const double *part = source[j] < 0 ? own : received + source[j] * NR;
      for (int c = 0; c < NR; c++) sum[c] += part[c];
    }
    memcpy(own, sum, sizeof sum);
  }
}

/* Prescribed motion: rates of prescribed components that bring x to its target at the step's end.
 * Entries come node by node; mean and eta are M^ and D per class (n x n). Adds the supports' work
 * h R.(v+ + v-)/2 with h R = M^ (v+ - v-) + h D (v+ + v-)/2 - h f, and corrects what update() will
 * count with v- already overwritten. Returns the power of the supports. */
double cb_move(const state *s, int64_t count, const int64_t *node, const int32_t *component,
               const double *target, const double *mean, const double *eta) {
  const double h = s->step;
  double power = 0;
  for (int64_t i = 0; i < count;) {
    const int64_t a = node[i], k = s->klass ? s->klass[a] : 0;
    double *x = s->x + a * NR, *v = s->v + a * NR, *f = s->f + a * NR, jump[N], both[N];
    int64_t last = i;
    memset(jump, 0, sizeof jump);
    for (int c = 0; c < N; c++) both[c] = 0;
    while (last < count && node[last] == a) {
      const int c = component[last];
      const double new = (target[last] - x[c]) / h;
      jump[c] = new - v[c];
      both[c] = new + v[c];
      v[c] = new;
      last++;
    }
    if (s->counted[a])
      for (; i < last; i++) {
        const int c = component[i];
        double reaction = -f[c], damping = 0, counted = 0;
        for (int j = 0; j < N; j++) {
          const double m = mean[k * N * N + c * N + j], d = eta[k * N * N + c * N + j];
          reaction += s->volume[a] * (m * jump[j] / h + 0.5 * d * both[j]);
          damping += d * both[j];
          counted += d * 2 * v[j];
        }
        power += 0.5 * reaction * both[c];
        s->sums[0] += 0.25 * h * s->volume[a] * (damping * both[c] - counted * 2 * v[c]);
        s->sums[c < NU ? 1 : 2] += s->volume[a] * fabs(jump[c]);
      }
    i = last;
  }
  s->sums[4] += h * power;
  return power;
}
