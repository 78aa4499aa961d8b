/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Asynchronous events: what nodes and cells carry, and how a node drifts from kick to kick. Behind
 * vectors.h, tabulated.h and quiet.h. A node's record holds everything a drift needs:
 *   [ position (NR) | rate (NR) | acceleration (NR, only if BALANCED) | time, 1/volume ]
 * and on an EXACT schedule that is DAMPED what the node has dissipated in place of an acceleration:
 * its drifts have an order, those of different nodes depend on how the schedule goes.
 * time and 1/volume sit in the padding of position where there is room (TIME, INVERSE).
 * Needs N, NU, NR, DIM, GEOMETRY, COEFFICIENTS, BALANCED, DAMPED, SCHEME, SLOW, CHUNK, EXACT. Unless
 * SLOW, inertia is diagonal and the components of nu share one rate: so do those of `plain`
 * classes. */

#define VN (NR < 8 ? NR : 8)
typedef double nvec __attribute__((vector_size(8 * VN), aligned(8)));
#define LOSING (EXACT && DAMPED)
#define PARTS (2 + BALANCED + LOSING)
#if NR - N >= 2
#define RECORD (PARTS * NR)
#define TIME N
#define INVERSE (N + 1)
#else
#define RECORD ((PARTS + (NR < 2 ? 2 : 1)) * NR) /* whole vectors: none straddles a cache line */
#define TIME (PARTS * NR)
#define INVERSE (PARTS * NR + 1)
#endif

#define HELD (BALANCED * (DIM + 1) * N) /* nodal forces that a cell holds */
#define SENT ((1 + BALANCED) * NR)      /* what a shared node collects: impulse, change of force */

typedef struct { int64_t first, last, region, divisions, chunk; double step; } group; /* blocks, N_K, h_K */
typedef struct { double time; int64_t group; } happening; /* a group acts, time within the window */

typedef struct {
  int64_t nodes, late, beyond; /* kicks of nodes [late, beyond) are collected for the exchange */
  double *record;             /* [node][RECORD] */
  const int32_t *klass;       /* class of a node, or NULL */
  const double *inverse_mass; /* [class][NR]: 0 where prescribed; 1 where there is no inertia */
  const double *rate;         /* [class][NR]: eta / inertia */
  const double *pace, *paced; /* of plain classes: [class] the one rate of a class, [class][NR] 1 where it holds */
  const uint8_t *plain;       /* if SLOW: [class] 1 where a node may be drifted as if it were not */
  const double *compliance;   /* [class][NR]: 1 / eta where there is no inertia, else 0 */
  const double *eta;          /* [class][NR]: damping per volume */
  const double *basis;        /* [class][N][N]: V, in which all these are diagonal */
  double *collected;          /* [shared nodes][SENT] */
  const group *groups;
  const int32_t *cell;
  const double *geometry, *coefficient;
  double *held;               /* [block][vertex][N][lane]: the force that acts until the next event */
  const double *blend;        /* [group][NR]: k */
  double *sums;               /* dissipated work */
  const uint8_t *counted;
  const double *coordinates;  /* [node][3], and for tabulated regions [region]: */
  const tabulated *forms;
  const int32_t *touched;     /* the nodes of each chunk of CHUNK blocks no chunk of its group had */
  const int64_t *touched_from; /* [chunk + 1] */
  activity *activity;         /* of chunks of CHUNK blocks and ranges of RANGE nodes, or NULL */
  double start;               /* of the window */
} world;

#if SLOW
/* True if W nodes are all of plain classes. */
INLINE int all_plain(const world *s, const int32_t *nodes) {
  if (!s->klass) return s->plain[0];
  int all = 1;
  for (int l = 0; l < W; l++) all &= s->plain[s->klass[nodes[l]]];
  return all;
}
#else
#define all_plain(s, nodes) 1
#endif

INLINE double *record_of(const world *s, int64_t a) { return s->record + a * RECORD; }

/* Drifts. With rate z = eta dt / inertia, a constant acceleration a (0 unless BALANCED), and a mean
 * rate over dt, x += dt mean, where for the schemes 0 exact, 1 symmetric, 2 forward
 *   mean = c1 v + c2 a,  v <- c3 v + c4 a,
 * exact: the flow of x'' + (eta/inertia) x' = a, with p1 = (1 - e^-z)/z and p2 = (1 - p1)/z. */

INLINE vec choose(ivec mask, vec yes, vec no) {
  return (vec)(((ivec)yes & mask) | ((ivec)no & ~mask));
}

/* (1 - e^-z)/z for z >= 0, to round-off: a series below 1/2, else e^-z by range reduction. */
INLINE vec phi1(vec z) {
  const vec y = choose(z < 0.5, z, (vec){0} + 0.25);
  vec series = (vec){0} + 1.0 / 1307674368000.0;
  static const double c[] = {1.0 / 87178291200.0, 1.0 / 6227020800.0, 1.0 / 479001600.0,
                             1.0 / 39916800.0, 1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0,
                             1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0};
  for (int i = 0; i < 14; i++) series = c[i] - y * series;
  if (__builtin_expect(1, 1)) {
    int large = 0;
    for (int l = 0; l < W; l++) large |= z[l] >= 0.5;
    if (!large) return series;
  }
  vec direct;
  for (int l = 0; l < W; l++) direct[l] = z[l] >= 0.5 ? -expm1(-z[l]) / z[l] : 1.0;
  return choose(z < 0.5, series, direct);
}

/* (1 - p1)/z, by its own series where the difference cancels. */
INLINE vec phi2(vec z, vec p1) {
  const ivec small = z < 0.1;
  const vec y = choose(small, z, (vec){0} + 0.1);
  vec series = (vec){0} + 1.0 / 479001600.0;
  static const double c[] = {1.0 / 39916800.0, 1.0 / 3628800.0, 1.0 / 362880.0, 1.0 / 40320.0,
                             1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5};
  for (int i = 0; i < 10; i++) series = c[i] - y * series;
  return choose(small, series, (1.0 - p1) / choose(small, (vec){0} + 1.0, z));
}

typedef struct { vec dt, c1, c2, c3, c4; } drifting;

INLINE drifting coefficients(vec dt, vec z) {
  drifting d;
  d.dt = dt;
#if SCHEME == 0
  d.c1 = phi1(z);
  d.c2 = dt * phi2(z, d.c1);
  d.c3 = 1.0 - z * d.c1;
  d.c4 = dt * d.c1;
#elif SCHEME == 1
  d.c1 = 1.0 / (1.0 + 0.5 * z);
  d.c2 = 0.5 * dt * d.c1;
  d.c3 = 2.0 * d.c1 - 1.0;
  d.c4 = 2.0 * d.c2;
#else
  d.c1 = 1.0 / (1.0 + z);
  d.c2 = dt * choose(z > 0.0, d.c1, (vec){0} + 0.5); /* undamped nodes move along parabolas */
  d.c3 = d.c1;
  d.c4 = dt * d.c1;
#endif
  return d;
}

#if SLOW
/* In a class's basis V (VT M V and VT D V diagonal) rates y stand for v = V y; component by
 * component, since they may differ in eta/inertia. Those without inertia (y is then momentum per
 * volume) spend it at once. */
INLINE void drift_slowly(const world *s, int64_t a, double dt) {
  double *r = record_of(s, a), lost = 0, mean[N];
  const int64_t k = s->klass ? s->klass[a] : 0;
  const double *V = s->basis + k * N * N;
  if (dt == 0) return;
  for (int i = 0; i < N; i++) {
    const double soft = s->compliance[k * NR + i], force = BALANCED ? r[2 * NR + i] : 0.0;
    const vec zero = {0}, z = zero + s->rate[k * NR + i] * dt;
    double *v = r + NR + i;
    if (soft != 0) {
      mean[i] = soft * (*v / dt + force);
      *v = 0;
    } else if (z[0] == 0) {
      mean[i] = *v + 0.5 * dt * force;
      *v += dt * force;
    } else {
      const drifting d = coefficients(zero + dt, z);
      mean[i] = d.c1[0] * *v + d.c2[0] * force;
      *v = d.c3[0] * *v + d.c4[0] * force;
    }
    lost += s->eta[k * NR + i] * mean[i] * mean[i];
  }
  for (int i = 0; i < N; i++) {
    double sum = 0;
    for (int j = 0; j < N; j++) sum += V[i * N + j] * mean[j];
    r[i] += dt * sum;
  }
#if LOSING
  r[2 * NR] += s->counted[a] ? dt * lost / r[INVERSE] : 0.0;
#else
  if (s->counted[a]) s->sums[0] += dt * lost / r[INVERSE];
#endif
}
#endif

/* Change of a node's rates by an impulse per volume: y += m^-1 VT impulse. */
INLINE void impulse(const world *s, int64_t a, const double *f, double weight, double *y) {
  const int64_t k = s->klass ? s->klass[a] : 0;
  const double *m = s->inverse_mass + k * NR;
#if SLOW
  const double *V = s->basis + k * N * N;
  for (int i = 0; i < N; i++) {
    double sum = 0;
    for (int j = 0; j < N; j++) sum += V[j * N + i] * f[j];
    y[i] += weight * m[i] * sum;
  }
#else
  for (int i = 0; i < N; i++) y[i] += weight * m[i] * f[i];
#endif
}

/* Position with its time set, where time sits in the padding: a scalar store there would stall the
 * vector loads that follow. */
INLINE nvec timed(nvec x, int g, double t) {
  if (TIME < NR && TIME / VN == g) x[TIME % VN] = t;
  return x;
}

/* Drift W nodes (which may repeat), each to its own t. */
INLINE void drift(const world *s, const int32_t *nodes, const vec t) {
#if SLOW
  if (!all_plain(s, nodes)) {
    for (int l = 0; l < W; l++) {
      double *r = record_of(s, nodes[l]);
      drift_slowly(s, nodes[l], t[l] - r[TIME]);
      r[TIME] = t[l];
    }
    return;
  }
#endif
#if DAMPED
  vec dt, z, volume;
  for (int l = 0; l < W; l++) {
    const double *r = record_of(s, nodes[l]);
    dt[l] = t[l] - r[TIME];
    z[l] = s->pace[s->klass ? s->klass[nodes[l]] : 0];
    volume[l] = s->counted[nodes[l]] ? r[INVERSE] : INFINITY;
  }
  const drifting d = coefficients(dt, z * dt);
  double c[5][W], weight[W];
  memcpy(c, &d, sizeof c);
  volume = dt / volume;
  memcpy(weight, &volume, sizeof weight);
#if !LOSING
  nvec lost[NR / VN];
  memset(lost, 0, sizeof lost);
#endif
  for (int l = 0; l < W; l++) {
    double *r = record_of(s, nodes[l]);
    if (r[TIME] == t[l]) continue; /* at rest in time, or a node that comes again */
    nvec *x = (nvec *)r, *v = (nvec *)(r + NR);
    const int64_t row = (s->klass ? s->klass[nodes[l]] : 0) * NR;
    const nvec *eta = (const nvec *)(s->eta + row), *nu = (const nvec *)(s->paced + row);
    for (int g = 0; g < NR / VN; g++) {
#if BALANCED
      const nvec a = ((nvec *)(r + 2 * NR))[g];
      const nvec mean = v[g] + 0.5 * c[0][l] * a +
                        nu[g] * ((c[1][l] - 1.0) * v[g] + (c[2][l] - 0.5 * c[0][l]) * a);
      v[g] += c[0][l] * a + nu[g] * ((c[3][l] - 1.0) * v[g] + (c[4][l] - c[0][l]) * a);
#else
      const nvec mean = v[g] + nu[g] * ((c[1][l] - 1.0) * v[g]);
      v[g] += nu[g] * ((c[3][l] - 1.0) * v[g]);
#endif
      x[g] = timed(x[g] + c[0][l] * mean, g, t[l]);
#if LOSING
      ((nvec *)(r + 2 * NR))[g] += weight[l] * eta[g] * mean * mean;
#else
      lost[g] += weight[l] * eta[g] * mean * mean;
#endif
    }
    if (TIME >= NR) r[TIME] = t[l];
  }
#if !LOSING
  double sum = 0;
  for (int i = 0; i < NR; i++) sum += lost[i / VN][i % VN];
  s->sums[0] += sum;
#endif
#else
  for (int l = 0; l < W; l++) {
    double *r = record_of(s, nodes[l]);
    const double dt = t[l] - r[TIME];
    nvec *x = (nvec *)r, *v = (nvec *)(r + NR);
    for (int g = 0; g < NR / VN; g++) {
#if BALANCED
      const nvec a = ((nvec *)(r + 2 * NR))[g];
      x[g] = timed(x[g] + dt * (v[g] + (0.5 * dt) * a), g, t[l]);
      v[g] += dt * a;
#else
      x[g] = timed(x[g] + dt * v[g], g, t[l]);
#endif
    }
    if (TIME >= NR) r[TIME] = t[l];
  }
#endif
}
