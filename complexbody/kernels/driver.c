/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Loops over blocks of cells and over nodes: forces, energies, and the synchronous step.
 *
 * Assembled behind vectors.h and the regions' functions; needs N, NU, NR, DIM, GEOMETRY,
 * COEFFICIENTS, DIAGONAL, DAMPED, FORCE(region, ...), ENERGY(region, ...).
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
} state;

#define VN (NR < 8 ? NR : 8) /* components of one node vector */
typedef double nvec __attribute__((vector_size(8 * VN)));
typedef long long nivec __attribute__((vector_size(8 * VN)));
#define AT(p, a) ((nvec *)((p) + (int64_t)(a) * NR))

INLINE nvec nabs(nvec a) { return (nvec)((nivec)a & 0x7fffffffffffffffLL); }

static void force_chunk(const state *s, const chunk *t) {
  if (t->last > t->first)
    FORCE(t->region, t->last - t->first, t->first, s->cell + t->first * (DIM + 1) * W,
          s->geometry + t->first * GEOMETRY * W, s->coefficient + t->first * COEFFICIENTS * W, s);
}

/* Kick and drift the nodes [first, last) and make f ready for the next step. Sums: dissipated
 * work h/4 (v+ + v-) D (v+ + v-), and the variation of the rates, the integral of |v+ - v-|_1. */
static void update(const state *s, int64_t first, int64_t last) {
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
    for (int i = 0; i < NU; i++) now[i] = al[i * N + i] * vo[i] + be[i * N + i] * iv * fo[i];
    for (int i = NU; i < N; i++) {
      double sum = 0;
      for (int j = NU; j < N; j++) sum += al[i * N + j] * vo[j] + be[i * N + j] * iv * fo[j];
      now[i] = sum;
    }
#if DAMPED
    for (int i = NU; i < N; i++)
      for (int j = NU; j < N; j++)
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

/* Whole step on this rank alone: each chunk of cells, then the nodes no later cell touches. */
static void fused(const state *s, int64_t first_chunk) {
  int64_t node = first_chunk ? s->table[first_chunk - 1].nodes : 0;
  for (int64_t c = first_chunk; c < s->chunks; c++) {
    force_chunk(s, s->table + c);
    update(s, node, s->table[c].nodes);
    node = s->table[c].nodes;
  }
}

/* Chunks whose cells touch nodes shared with other ranks, with the nodes complete after them. */
void cb_boundary_forces(const state *s) {
  int64_t node = 0;
  for (int64_t c = 0; c < s->boundary_chunks; c++) {
    force_chunk(s, s->table + c);
    update(s, node, s->table[c].nodes);
    node = s->table[c].nodes;
  }
}

void cb_interior_step(const state *s) { fused(s, s->boundary_chunks); }

void cb_update(const state *s, int64_t first, int64_t last) { update(s, first, last); }

/* All forces on top of what f holds, nodes untouched. */
void cb_forces(const state *s) {
  for (int64_t c = 0; c < s->chunks; c++) force_chunk(s, s->table + c);
}

/* Forces of some chunks of cells only, on top of what f holds. */
void cb_forces_of(const state *s, const chunk *table, int64_t count) {
  for (int64_t c = 0; c < count; c++) force_chunk(s, table + c);
}

/* out[2 r] += stored, out[2 r + 1] += potential energy of region r. */
void cb_energies(const state *s, double *out) {
  for (int64_t c = 0; c < s->chunks; c++) {
    const chunk *t = s->table + c;
    if (t->last > t->first)
      ENERGY(t->region, t->last - t->first, t->first, s->cell + t->first * (DIM + 1) * W,
             s->geometry + t->first * GEOMETRY * W, s->coefficient + t->first * COEFFICIENTS * W, s,
             out + 2 * t->region);
  }
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
    fused(s, 0);
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

/* rates = a v + b f / volume at nodes [first, last): rates at the step's own time. */
void cb_rates(const state *s, const double *a, const double *b, int64_t first, int64_t last,
              double *rates) {
  for (int64_t m = first; m < last; m++) {
    const int64_t k = s->klass ? s->klass[m] : 0;
    const double *v = s->v + m * NR, *f = s->f + m * NR;
    for (int i = 0; i < N; i++) {
#if DIAGONAL
      rates[m * NR + i] = a[k * NR + i] * v[i] + b[k * NR + i] * s->inverse_volume[m] * f[i];
#else
      double sum = 0;
      for (int j = 0; j < N; j++)
        sum += a[k * N * N + i * N + j] * v[j] + b[k * N * N + i * N + j] * s->inverse_volume[m] * f[j];
      rates[m * NR + i] = sum;
#endif
    }
  }
}

/* Half the sum over counted nodes of volume * w.m w on components [c0, c1), m per class (n x n). */
double cb_quadratic(const state *s, const double *matrix, const double *w, int64_t c0, int64_t c1) {
  double total = 0;
  for (int64_t a = 0; a < s->nodes; a++) {
    if (!s->counted[a]) continue;
    const double *m = matrix + (s->klass ? s->klass[a] : 0) * N * N, *r = w + a * NR;
    double sum = 0;
#if DIAGONAL
    for (int64_t i = c0; i < c1; i++) sum += m[i * N + i] * r[i] * r[i];
#else
    for (int64_t i = c0; i < c1; i++)
      for (int64_t j = c0; j < c1; j++) sum += m[i * N + j] * r[i] * r[j];
#endif
    total += 0.5 * s->volume[a] * sum;
  }
  return total;
}

/* Sum over counted nodes of f.(x - h v): forces on the positions one step before. */
double cb_force_before(const state *s) {
  double total = 0;
  for (int64_t a = 0; a < s->nodes; a++) {
    if (!s->counted[a]) continue;
    const double *x = s->x + a * NR, *v = s->v + a * NR, *f = s->f + a * NR;
    for (int i = 0; i < N; i++) total += f[i] * (x[i] - s->step * v[i]);
  }
  return total;
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
