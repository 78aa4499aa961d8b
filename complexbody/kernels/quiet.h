/* SPDX-License-Identifier: LGPL-3.0-or-later
 * Quiet cells: whose nodes are all at zero, so that their forces are zero and need no evaluation.
 *
 * Cells lie in chunks, nodes in ranges. A chunk is `awake` as soon as any of its nodes is not at zero;
 * a range is `stirred` if a chunk that touches it is awake, or something else acts on its nodes. Only
 * chunks with nodes in stirred ranges, `near` ones, can find a node that is not at zero. Nothing goes
 * back to sleep. What is skipped would add zero to sums: no bit changes. */
#include <stdint.h>
#include <string.h>
#ifndef INLINE
#define INLINE static inline __attribute__((always_inline))
#endif

typedef struct {
  int64_t on;                 /* 0 once nearly all chunks are awake: nothing is skipped any more */
  int64_t chunks, cells, awake_cells;
  int64_t skipped;            /* cell updates */
  uint8_t *awake, *near;      /* [chunk] */
  uint8_t *stirred;           /* [range] */
  const int64_t *size;        /* [chunk]: cells */
  const int64_t *node_from;   /* the nodes of each chunk, [chunk + 1] */
  const int32_t *node;
  const int64_t *range_from;  /* the ranges it touches, [chunk + 1] */
  const int32_t *range;
  const int64_t *chunk_from;  /* and the chunks that touch each range, [range + 1] */
  const int32_t *chunk;
} activity;

#define ENOUGH 0.9 /* of the cells awake: what is left to skip is not worth looking for */

INLINE int at_zero(const double *p, int count) {
  int64_t any = 0;
  for (int i = 0; i < count; i++) {
    int64_t bits;
    memcpy(&bits, p + i, sizeof bits);
    any |= bits;
  }
  return !(any & 0x7fffffffffffffffLL);
}

static void stir(activity *q, int64_t r) {
  if (q->stirred[r]) return;
  q->stirred[r] = 1;
  for (int64_t i = q->chunk_from[r]; i < q->chunk_from[r + 1]; i++) q->near[q->chunk[i]] = 1;
}

static void wake(activity *q, int64_t c) {
  if (q->awake[c]) return;
  q->awake[c] = 1;
  q->awake_cells += q->size[c];
  for (int64_t i = q->range_from[c]; i < q->range_from[c + 1]; i++) stir(q, q->range[i]);
  if (q->awake_cells > ENOUGH * q->cells) q->on = 0;
}

/* Wake chunk c if it is near and a node of it is not at zero in x, [node][size]. */
__attribute__((unused)) static void look_at(activity *q, int64_t c, const double *x, int size) {
  if (q->awake[c] || !q->near[c]) return;
  for (int64_t i = q->node_from[c]; i < q->node_from[c + 1]; i++)
    if (!at_zero(x + (int64_t)q->node[i] * size, size)) {
      wake(q, c);
      return;
    }
}

/* For the start: what acts on nodes stirs their ranges, and some chunks are awake from then on. */
void cb_stir(activity *q, int64_t count, const int64_t *range) {
  for (int64_t i = 0; i < count; i++) stir(q, range[i]);
}

void cb_wake(activity *q, int64_t count, const int64_t *chunk) {
  for (int64_t i = 0; i < count; i++) wake(q, chunk[i]);
}

/* The distinct values below `most` of each group values[from[g] .. from[g + 1]), in the order met, into
 * `out`; stamp[most] is scratch. */
void cb_distinct(int64_t groups, const int64_t *from, const int32_t *values, int32_t most,
                    int32_t *stamp, int64_t *out_from, int32_t *out) {
  int64_t count = 0;
  memset(stamp, 0, most * sizeof *stamp);
  for (int64_t g = 0; g < groups; g++) {
    out_from[g] = count;
    for (int64_t i = from[g]; i < from[g + 1]; i++) {
      const int32_t v = values[i];
      if (v >= most || stamp[v] == g + 1) continue;
      stamp[v] = (int32_t)(g + 1);
      out[count++] = v;
    }
  }
  out_from[groups] = count;
}
