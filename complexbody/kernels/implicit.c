/* SPDX-License-Identifier: LGPL-3.0-or-later
 * One step of the implicit integrator with the vertex rule: a K x K Newton per node, no global solve.
 *
 * Needs N, NU, NR, K. With s = 0 (paper section 5) or 1/2 (midpoint) and m = nu + h s r, the rates r
 * of the next drift satisfy, per node and integrated over its volume,
 *   p(m, r) - (1-s) h q(m, r) + (1-s) h eta r = momentum + h f,   p = dchi/dnu_dot, q = dchi/dnu,
 * and the drift leaves momentum = p + s h q - s h eta r. Two passes: the first only solves, so that
 * a failure anywhere leaves the last state whole.
 *
 * Where p = q = 0 at nu = r = 0, nodes at zero without force stay there, with no iteration: those of
 * quiet ranges are passed by. Behind quiet.h. */
#include <math.h>

typedef void (*tabulate)(double *, const double *, const double *, const double *, const int *,
                         const uint8_t *, void *);
typedef struct {
  tabulate chi;      /* NULL: constant inertia */
  double *constants; /* read by chi; nu and its rate are written into it */
  int64_t at_nu, at_rate;
  double omega[K * K], eta[K * K];
} material;

typedef struct {
  int64_t nodes, most, unstable_ok, ranges;
  double h, s, tolerance;
  double *x, *v, *f, *previous, *next; /* [node][NR] */
  double *momentum, *after;            /* [node][K] */
  double *reaction;                    /* impulse on prescribed components [node][NR], or NULL */
  const double *volume, *density;      /* [node] */
  const uint8_t *fixed, *counted;      /* [node][N], [node] */
  const int64_t *start;                /* parts of a node: [nodes + 1] */
  const int32_t *region;               /* of a part */
  const double *share;                 /* volume of a part */
  material *materials;
  const double *position;              /* [node][3] */
  double *sums;                        /* as in driver.c */
  int64_t *count;                      /* Newton iterations: all, most; solves */
  const activity *activity;            /* or NULL */
  const int64_t *ends;                 /* of ranges of nodes, [ranges] */
} implicit;

/* Nodes a, but for those of quiet ranges. */
#define EACH_NODE(s, a)                                                                            \
  const activity *q_ = (s)->activity && (s)->activity->on ? (s)->activity : NULL;                  \
  for (int64_t r_ = 0; r_ < (s)->ranges; r_++)                                                     \
    if (!q_ || q_->stirred[r_])                                                                    \
      for (int64_t a = r_ ? (s)->ends[r_ - 1] : 0; a < (s)->ends[r_]; a++)

typedef struct { double chi, p[K], q[K], pv[K][K], pn[K][K], qq[K][K], eta[K][K]; } local;

static void evaluate(const implicit *s, int64_t a, const double *nu, const double *rate, local *o) {
  memset(o, 0, sizeof *o);
  for (int64_t i = s->start[a]; i < s->start[a + 1]; i++) {
    const double share = s->share[i];
    material *m = s->materials + s->region[i];
    for (int j = 0; j < K * K; j++) ((double *)o->eta)[j] += share * m->eta[j];
    if (!m->chi) {
      for (int r = 0; r < K; r++)
        for (int c = 0; c < K; c++) {
          const double w = share * m->omega[r * K + c];
          o->pv[r][c] += w;
          o->p[r] += w * rate[c];
          o->chi += 0.5 * w * rate[r] * rate[c];
        }
      continue;
    }
    double out[1 + 2 * K + 3 * K * K] = {0}, corner[12];
    for (int j = 0; j < 12; j++) corner[j] = s->position[3 * a + j % 3];
    if (m->at_nu >= 0) memcpy(m->constants + m->at_nu, nu, K * sizeof(double));
    if (m->at_rate >= 0) memcpy(m->constants + m->at_rate, rate, K * sizeof(double));
    const int zero = 0; const uint8_t none = 0;
    m->chi(out, NULL, m->constants, corner, &zero, &none, 0);
    o->chi += share * out[0];
    for (int j = 0; j < K; j++) o->p[j] += share * out[1 + j], o->q[j] += share * out[1 + K + j];
    const double *second = out + 1 + 2 * K;
    for (int j = 0; j < K * K; j++) {
      ((double *)o->pv)[j] += share * second[j];
      ((double *)o->pn)[j] += share * second[K * K + j];
      ((double *)o->qq)[j] += share * second[2 * K * K + j];
    }
  }
}

/* Solve A x = b by elimination with pivots; 0 if A is singular. */
static int eliminate(double A[K][K], double *b) {
  for (int i = 0; i < K; i++) {
    int best = i;
    for (int j = i + 1; j < K; j++) if (fabs(A[j][i]) > fabs(A[best][i])) best = j;
    if (!(fabs(A[best][i]) > 0)) return 0;
    for (int c = 0; c < K && best != i; c++) {
      const double t = A[i][c]; A[i][c] = A[best][c]; A[best][c] = t;
    }
    const double t = b[i]; b[i] = b[best]; b[best] = t;
    for (int j = i + 1; j < K; j++) {
      const double factor = A[j][i] / A[i][i];
      for (int c = i; c < K; c++) A[j][c] -= factor * A[i][c];
      b[j] -= factor * b[i];
    }
  }
  for (int i = K - 1; i >= 0; i--) {
    for (int c = i + 1; c < K; c++) b[i] -= A[i][c] * b[c];
    b[i] /= A[i][i];
  }
  return 1;
}

/* Is the symmetric part of A positive definite on free components? */
static int definite(const double A[K][K], const uint8_t *fixed) {
  double L[K][K];
  for (int i = 0; i < K; i++)
    for (int j = 0; j <= i; j++) {
      const int free = !fixed[i] && !fixed[j];
      double sum = free ? 0.5 * (A[i][j] + A[j][i]) : (i == j);
      for (int c = 0; c < j; c++) sum -= L[i][c] * L[j][c];
      if (i == j) {
        if (!(sum > 0)) return 0;
        L[i][i] = sqrt(sum);
      } else L[i][j] = sum / L[j][j];
    }
  return 1;
}

enum { FINE, NOT_FINITE, BEYOND, NOT_CONVEX, SINGULAR, SLOW };

/* Residual and Jacobian at rates r; norms of the residual and of its terms. */
static double residual(const implicit *s, int64_t a, double h, const double *r, const double *b,
                       const uint8_t *fixed, local *o, double *g, double J[K][K], double *size) {
  const double w = s->s;
  const double *nu = s->x + a * NR + NU;
  double m[K], norm = 0, terms = 0;
  for (int i = 0; i < K; i++) m[i] = nu[i] + h * w * r[i];
  evaluate(s, a, m, r, o);
  for (int i = 0; i < K; i++) {
    double damping = 0;
    for (int j = 0; j < K; j++) {
      damping += o->eta[i][j] * r[j];
      J[i][j] = o->pv[i][j] + h * w * o->pn[i][j] + (1 - w) * h * o->eta[i][j] -
                (1 - w) * h * (o->pn[j][i] + h * w * o->qq[i][j]);
    }
    g[i] = o->p[i] + (1 - w) * h * (damping - o->q[i]) - b[i];
    if (fixed[i]) continue;
    norm = fmax(norm, fabs(g[i]));
    terms = fmax(terms, fmax(fabs(b[i]), fmax(fabs(o->p[i]), h * fmax(fabs(o->q[i]), fabs(damping)))));
    if (!isfinite(g[i])) return NAN;
  }
  *size = terms;
  return norm;
}

static int newton(const implicit *s, int64_t a, double h, double *r, const double *b, local *o,
                  int64_t *done) {
  const uint8_t *fixed = s->fixed + a * N + NU;
  double g[K], J[K][K], size, norm = residual(s, a, h, r, b, fixed, o, g, J, &size);
  if (!isfinite(norm)) return NOT_FINITE;
  for (int64_t n = 0; norm > s->tolerance * size; n++) {
    if (n == s->most) return SLOW;
    *done = n + 1;
    for (int i = 0; i < K; i++) {
      if (fixed[i]) {
        for (int c = 0; c < K; c++) J[i][c] = i == c;
        g[i] = 0;
      }
    }
    if (!eliminate(J, g)) return SINGULAR;
    double trial[K], better = NAN, smallest = 0;
    /* A step that makes it worse is halved: far from the solution chi need not be convex. */
    for (double part = 1; part > 1e-3; part *= 0.5) {
      double gt[K];
      for (int i = 0; i < K; i++) trial[i] = r[i] - part * g[i];
      better = residual(s, a, h, trial, b, fixed, o, gt, J, &size);
      if (isfinite(better) && (better < norm || better <= s->tolerance * size)) {
        memcpy(g, gt, sizeof g);
        smallest = part;
        break;
      }
    }
    if (smallest == 0) {
      /* At round-off nothing gets better any more. */
      if (norm <= 1e3 * s->tolerance * size) { residual(s, a, h, r, b, fixed, o, g, J, &size); break; }
      return isfinite(better) ? SLOW : NOT_FINITE;
    }
    memcpy(r, trial, sizeof trial);
    norm = better;
  }
  if (!definite((const double (*)[K])o->pv, fixed)) return NOT_CONVEX;
  if (!s->unstable_ok && !definite((const double (*)[K])J, fixed)) return BEYOND;
  return FINE;
}

/* Solve at all nodes for the next rates; returns the reason and *node of a failure. */
int64_t im_solve(const implicit *s, int64_t *node, int64_t *iterations) {
  const double h = s->h;
  EACH_NODE(s, a) {
    const double *v = s->v + a * NR, *f = s->f + a * NR;
    double *next = s->next + a * NR, r[K], b[K];
    const uint8_t *fixed = s->fixed + a * N;
    const double mass = s->volume[a] * s->density[a];
    for (int i = 0; i < NU; i++) if (!fixed[i]) next[i] = v[i] + h * f[i] / mass;
    for (int i = 0; i < K; i++) {
      r[i] = fixed[NU + i] ? next[NU + i] : 2 * v[NU + i] - s->previous[a * NR + NU + i];
      b[i] = s->momentum[a * K + i] + h * f[NU + i];
    }
    local o;
    int64_t done = 0;
    const int reason = newton(s, a, h, r, b, &o, &done);
    s->count[0] += done;
    if (done > s->count[1]) s->count[1] = done;
    if (reason) { *node = a; *iterations = done; memcpy(next + NU, r, sizeof r); return reason; }
    double damping[K] = {0};
    for (int i = 0; i < K; i++)
      for (int j = 0; j < K; j++) damping[i] += o.eta[i][j] * r[j];
    for (int i = 0; i < K; i++) {
      s->after[a * K + i] = o.p[i] + s->s * h * (o.q[i] - damping[i]);
      next[NU + i] = r[i];
    }
    if (s->reaction)
      for (int i = 0; i < N; i++)
        s->reaction[a * NR + i] =
            i < NU ? mass * (next[i] - v[i]) - h * f[i]
                   : o.p[i - NU] + (1 - s->s) * h * (damping[i - NU] - o.q[i - NU]) - b[i - NU];
  }
  s->count[2]++;
  return FINE;
}

/* Take the step that im_solve found. */
void im_commit(const implicit *s) {
  const double h = s->h;
  double lost = 0, jump_u = 0, jump_nu = 0;
  EACH_NODE(s, a) {
    double *x = s->x + a * NR, *v = s->v + a * NR, *next = s->next + a * NR;
    const double vol = s->counted[a] ? s->volume[a] : 0.0, *r = next + NU;
    for (int64_t i = s->start[a]; i < s->start[a + 1] && vol > 0; i++)
      for (int j = 0; j < K * K; j++)
        lost += h * s->share[i] * s->materials[s->region[i]].eta[j] * r[j / K] * r[j % K];
    for (int i = 0; i < N; i++) {
      *(i < NU ? &jump_u : &jump_nu) += vol * fabs(next[i] - v[i]);
      s->previous[a * NR + i] = v[i];
      v[i] = next[i];
      x[i] += h * next[i];
    }
    memcpy(s->momentum + a * K, s->after + a * K, K * sizeof(double));
  }
  s->sums[0] += lost;
  s->sums[1] += jump_u;
  s->sums[2] += jump_nu;
}

/* 1 for nodes where p or q is not zero at nu = rate = 0. */
void im_restless(const implicit *s, uint8_t *flags) {
  const double zero[K] = {0};
  for (int64_t a = 0; a < s->nodes; a++) {
    local o;
    evaluate(s, a, zero, zero, &o);
    flags[a] = !at_zero(o.p, K) || !at_zero(o.q, K);
  }
}

/* Momentum p(nu, rate) of given rates, integrated: [node][K]. */
void im_momentum(const implicit *s, const double *rates, double *momentum) {
  for (int64_t a = 0; a < s->nodes; a++) {
    local o;
    evaluate(s, a, s->x + a * NR + NU, rates + a * NR + NU, &o);
    memcpy(momentum + a * K, o.p, sizeof o.p);
  }
}

/* Rates with p(nu, rate) = momentum at this time (rates holds the guess); as im_solve. */
int64_t im_rates(const implicit *s, const double *momentum, double *rates, int64_t *node,
                 int64_t *iterations) {
  for (int64_t a = 0; a < s->nodes; a++) {
    local o;
    int64_t done = 0;
    const int reason = newton(s, a, 0.0, rates + a * NR + NU, momentum + a * K, &o, &done);
    if (reason) { *node = a; *iterations = done; return reason; }
  }
  return FINE;
}

/* Kinetic energy p.rate - chi of counted nodes. */
double im_kinetic(const implicit *s, const double *rates) {
  double total = 0;
  for (int64_t a = 0; a < s->nodes; a++) {
    if (!s->counted[a]) continue;
    local o;
    const double *r = rates + a * NR + NU;
    evaluate(s, a, s->x + a * NR + NU, r, &o);
    for (int i = 0; i < K; i++) total += o.p[i] * r[i];
    total -= o.chi;
  }
  return total;
}
