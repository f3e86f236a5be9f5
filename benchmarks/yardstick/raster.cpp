// SPDX-License-Identifier: GPL-3.0-or-later
// A hand-written rasterizer that the compiled kernels are measured against: nine
// features and alpha, forward and backward, no depth. It reads and writes the buffers of the
// kernels, so that results can be compared and both pay for the same traffic.
//
// A run is LANES neighbouring pixels of one row of a tile, -DLANES=8 or 16. Each Gaussian of a tile
// is blended into the rows that its ellipse reaches, with the tile's state in the L1 cache. The other
// scheme, a list of Gaussians per run and the state in registers, was as fast with AVX-512 (within
// 3 %) and a fifth slower forward with AVX2, so it was dropped; so were runs of 16 with AVX2 and of 8
// with AVX-512 (32 % and 35 % slower, forward and backward).

#include <stdint.h>
#include <string.h>
#if defined(__AVX2__)
#include <immintrin.h>
#endif

#ifndef LANES
#define LANES 16
#endif

namespace {

constexpr int TILE = 16, PLANE = TILE * TILE, FEATURES = 9, VALUES = 24;
constexpr int HALVES = TILE / LANES, AHEAD = 8;
constexpr float ALPHA_MIN = 1.0f / 255.0f, ALPHA_MAX = 0.99f, T_MIN = 1e-4f;

typedef float V __attribute__((vector_size(4 * LANES), aligned(4 * LANES)));
typedef int32_t I __attribute__((vector_size(4 * LANES), aligned(4 * LANES)));
typedef float V4 __attribute__((vector_size(16), aligned(4)));

inline V same(float x) { return V{} + x; }
inline V masked(I mask, V value) { return (V)((I)value & mask); }

#if defined(__AVX512F__) && LANES == 16
inline bool any(I mask) { return _mm512_movepi32_mask((__m512i)mask) != 0; }
inline V smaller(V a, V b) { return (V)_mm512_min_ps((__m512)a, (__m512)b); }
inline V larger(V a, V b) { return (V)_mm512_max_ps((__m512)a, (__m512)b); }
#elif defined(__AVX2__) && LANES == 8
inline bool any(I mask) { return _mm256_movemask_ps((__m256)mask) != 0; }
inline V smaller(V a, V b) { return (V)_mm256_min_ps((__m256)a, (__m256)b); }
inline V larger(V a, V b) { return (V)_mm256_max_ps((__m256)a, (__m256)b); }
#else
inline bool any(I mask) {
  typedef int64_t L __attribute__((vector_size(4 * LANES)));
  L wide = (L)mask;
  int64_t found = 0;
  for (int i = 0; i < LANES / 2; i++) found |= wide[i];
  return found != 0;
}
inline V smaller(V a, V b) { return a < b ? a : b; }
inline V larger(V a, V b) { return a > b ? a : b; }
#endif

// Sums of four vectors at once: transposing while adding costs a third of four single sums.
inline V4 sums(V a, V b, V c, V d) {
#if defined(__AVX512F__) && LANES == 16
  __m512 ab = _mm512_unpacklo_ps((__m512)a, (__m512)b) + _mm512_unpackhi_ps((__m512)a, (__m512)b);
  __m512 cd = _mm512_unpacklo_ps((__m512)c, (__m512)d) + _mm512_unpackhi_ps((__m512)c, (__m512)d);
  __m512 four = _mm512_shuffle_ps(ab, cd, 0x44) + _mm512_shuffle_ps(ab, cd, 0xee);
  __m256 two = _mm512_castps512_ps256(four) + _mm512_extractf32x8_ps(four, 1);
  return (V4)(_mm256_castps256_ps128(two) + _mm256_extractf128_ps(two, 1));
#elif defined(__AVX2__) && LANES == 8
  __m256 ab = _mm256_unpacklo_ps((__m256)a, (__m256)b) + _mm256_unpackhi_ps((__m256)a, (__m256)b);
  __m256 cd = _mm256_unpacklo_ps((__m256)c, (__m256)d) + _mm256_unpackhi_ps((__m256)c, (__m256)d);
  __m256 four = _mm256_shuffle_ps(ab, cd, 0x44) + _mm256_shuffle_ps(ab, cd, 0xee);
  return (V4)(_mm256_castps256_ps128(four) + _mm256_extractf128_ps(four, 1));
#else
  V4 total = {0, 0, 0, 0};
  for (int i = 0; i < LANES; i++) total += V4{a[i], b[i], c[i], d[i]};
  return total;
#endif
}

// exp(-x) for 0 <= x <= 5.6, and less than 1/255 above: the kernels' own fit, so that the results
// can be compared to rounding.
inline V exp_short(V x) {
  x = smaller(x * 0.125f, same(0.7f));
  V p = x * 0.0009744596900418401f - 0.00794854387640953f;
  p = p * x + 0.04148262366652489f;
  p = p * x - 0.16662052273750305f;
  p = p * x + 0.4999943971633911f;
  p = p * x - 0.9999997615814209f;
  p = p * x + 1.0f;
  p = p * p;
  p = p * p;
  return p * p;
}

inline V columns() {
  V x;
  for (int i = 0; i < LANES; i++) x[i] = (float)i;
  return x;
}

// The part of an evaluation that forward and backward share.
struct Ray {
  V inverse, distance, raw, alpha;
};

inline Ray cast(V dx, float dy, const float *q) {
  V num = larger((dx * q[2] + q[3] * dy) * dx + q[4] * dy * dy, same(0.0f));
  V den = (dx * q[7] + (2.0f * q[5] + q[8] * dy)) * dx + (1.0f + (2.0f * q[6] + q[9] * dy) * dy);
  Ray ray;
  ray.inverse = 1.0f / larger(den, same(1e-20f));
  ray.distance = num * ray.inverse;
  ray.raw = exp_short(ray.distance * 0.5f) * q[11];
  ray.alpha = smaller(ray.raw, same(ALPHA_MAX));
  return ray;
}

struct Tile {
  int64_t begin, count, x, y, live_rows, live_columns;
};

inline Tile tile_at(int64_t tile, const int64_t *start, int64_t tiles_x, int64_t width,
                    int64_t height) {
  Tile t;
  t.begin = start[tile];
  t.count = start[tile + 1] - t.begin;
  t.y = tile / tiles_x * TILE;
  t.x = tile % tiles_x * TILE;
  t.live_rows = height - t.y < TILE ? height - t.y : TILE;
  t.live_columns = width - t.x < TILE ? width - t.x : TILE;
  return t;
}

inline void column_halves(const int32_t *range, int64_t tile_x, int &first, int &last) {
  first = 0;
  last = HALVES - 1;
  if (HALVES > 1) {
    int64_t left = range[2] - tile_x, right = range[3] - tile_x;
    first = left > 0 ? (int)left / LANES : 0;
    last = right < TILE - 1 ? (int)right / LANES : HALVES - 1;
  }
}

// T, then the features, plane by plane, to the images.
void write_tile(const float *m, const Tile &t, int64_t width, const float *background,
                float *color, float *normal, float *geometric, float *alpha) {
  for (int row = 0; row < t.live_rows; row++) {
    int64_t pixel = (t.y + row) * width + t.x;
    const float *s = m + row * TILE;
    for (int c = 0; c < t.live_columns; c++) {
      float through = s[c];
      alpha[pixel + c] = 1.0f - through;
      for (int k = 0; k < 3; k++) {
        color[3 * (pixel + c) + k] = s[(1 + k) * PLANE + c] + through * background[k];
        normal[3 * (pixel + c) + k] = s[(4 + k) * PLANE + c];
        geometric[3 * (pixel + c) + k] = s[(7 + k) * PLANE + c];
      }
    }
  }
}

}  // namespace

extern "C" {

int32_t lanes() { return LANES; }

void forward(int64_t first_tile, int64_t end_tile, const float *params, const int64_t *start,
             const int32_t *ids, const int32_t *ranges, const uint8_t *rows, int64_t tiles_x,
             int64_t width, int64_t height, const float *background, float *color, float *normal,
             float *geometric, float *alpha) {
  alignas(64) float m[(1 + FEATURES) * PLANE];
  const V column = columns();
  for (int64_t tile = first_tile; tile < end_tile; tile++) {
    Tile t = tile_at(tile, start, tiles_x, width, height);
    memset(m, 0, sizeof m);
    for (int row = 0; row < t.live_rows; row++)
      for (int c = 0; c < t.live_columns; c++) m[row * TILE + c] = 1.0f;
    uint32_t live = (1u << t.live_rows) - 1;
    for (int64_t k = 0; k < t.count && live; k++) {
      int64_t ahead = t.begin + (k + AHEAD < t.count ? k + AHEAD : t.count - 1);
      const float *soon = params + (int64_t)ids[ahead] * VALUES;
      __builtin_prefetch(soon);
      __builtin_prefetch(soon + VALUES - 1);
      int64_t i = ids[t.begin + k];
      const float *q = params + i * VALUES;
      int last = rows[2 * (t.begin + k) + 1], first_half, last_half;
      column_halves(ranges + 4 * i, t.x, first_half, last_half);
      for (int row = rows[2 * (t.begin + k)]; row <= last; row++) {
        if (!(live >> row & 1)) continue;
        float dy = (float)row - (q[1] - ((float)t.y + 0.5f));
        for (int half = first_half; half <= last_half; half++) {
          V dx = column - (q[0] - ((float)(t.x + half * LANES) + 0.5f));
          Ray ray = cast(dx, dy, q);
          V *state = (V *)(m + row * TILE + half * LANES);
          V T = state[0];
          I on = (ray.alpha >= ALPHA_MIN) & (T >= T_MIN);
          V w = masked(on, ray.alpha * T);
          state[0] = T - w;
          for (int f = 0; f < FEATURES; f++) state[(1 + f) * PLANE / LANES] += w * q[13 + f];
        }
      }
      if ((k & 15) == 15)
        for (int row = 0; row < TILE; row++) {
          const V *T = (const V *)(m + row * TILE);
          bool some = false;
          for (int half = 0; half < HALVES; half++) some |= any(T[half] >= T_MIN);
          if (!some) live &= ~(1u << row);
        }
    }
    write_tile(m, t, width, background, color, normal, geometric, alpha);
  }
}

void backward(int64_t first_tile, int64_t end_tile, const float *params, const int64_t *start,
              const int32_t *ids, const int32_t *slots, const int32_t *ranges,
              const uint8_t *rows, int64_t tiles_x, int64_t width, int64_t height,
              const float *color, const float *normal, const float *geometric, const float *alpha,
              const float *g_color, const float *g_normal, const float *g_geometric,
              const float *g_alpha, float *pairs) {
  // Planes: T, remaining, then the gradients of the features.
  alignas(64) float m[(2 + FEATURES) * PLANE];
  const V column = columns();
  for (int64_t tile = first_tile; tile < end_tile; tile++) {
    Tile t = tile_at(tile, start, tiles_x, width, height);
    if (t.count == 0) continue;
    memset(m, 0, sizeof m);
    for (int row = 0; row < t.live_rows; row++) {
      int64_t pixel = (t.y + row) * width + t.x;
      float *s = m + row * TILE;
      for (int c = 0; c < t.live_columns; c++) {
        float remaining = -g_alpha[pixel + c] * (1.0f - alpha[pixel + c]);
        for (int k = 0; k < 3; k++) {
          int64_t at = 3 * (pixel + c) + k;
          s[(2 + k) * PLANE + c] = g_color[at];
          s[(5 + k) * PLANE + c] = g_normal[at];
          s[(8 + k) * PLANE + c] = g_geometric[at];
          remaining += g_color[at] * color[at] + g_normal[at] * normal[at] +
                       g_geometric[at] * geometric[at];
        }
        s[c] = 1.0f;
        s[PLANE + c] = remaining;
      }
    }
    uint32_t live = (1u << t.live_rows) - 1;
    for (int64_t k = 0; k < t.count; k++) {
      int64_t ahead = t.begin + (k + AHEAD < t.count ? k + AHEAD : t.count - 1);
      const float *soon = params + (int64_t)ids[ahead] * VALUES;
      const float *out_soon = pairs + (int64_t)slots[ahead] * VALUES;
      __builtin_prefetch(soon);
      __builtin_prefetch(soon + VALUES - 1);
      __builtin_prefetch(out_soon, 1);
      __builtin_prefetch(out_soon + VALUES - 1, 1);
      int64_t i = ids[t.begin + k];
      const float *q = params + i * VALUES;
      float *out = pairs + (int64_t)slots[t.begin + k] * VALUES;
      const int last = rows[2 * (t.begin + k) + 1];
      int first_half, last_half;
      column_halves(ranges + 4 * i, t.x, first_half, last_half);
      const V zero = same(0.0f);
      V4 total[6] = {};
      bool hit = false;
      for (int half = first_half; half <= last_half; half++) {
        const V dx = column - (q[0] - ((float)(t.x + half * LANES) + 0.5f));
        V num = zero, num_y = zero, num_yy = zero, den = zero, den_y = zero, den_yy = zero;
        V distance = zero, s0 = zero, s1 = zero, s2 = zero, s3 = zero, s4 = zero, s5 = zero;
        V s6 = zero, s7 = zero, s8 = zero;
        bool reached = false;
        for (int row = rows[2 * (t.begin + k)]; row <= last; row++) {
          if (!(live >> row & 1)) continue;
          float dy = (float)row - (q[1] - ((float)t.y + 0.5f));
          V *state = (V *)(m + row * TILE + half * LANES);
          const V *g = state + 2 * PLANE / LANES;
          Ray ray = cast(dx, dy, q);
          V T = state[0];
          I on = (ray.alpha >= ALPHA_MIN) & (T >= T_MIN);
          if (!any(on)) continue;
          reached = true;
          V a = masked(on, ray.alpha), w = a * T;
          constexpr int P = PLANE / LANES;
          V g0 = g[0], g1 = g[P], g2 = g[2 * P], g3 = g[3 * P], g4 = g[4 * P], g5 = g[5 * P];
          V g6 = g[6 * P], g7 = g[7 * P], g8 = g[8 * P];
          V along = g0 * q[13] + g1 * q[14] + g2 * q[15] + g3 * q[16] + g4 * q[17] + g5 * q[18] +
                    g6 * q[19] + g7 * q[20] + g8 * q[21];
          V remaining = state[P] - w * along;
          state[P] = remaining;
          state[0] = T - w;
          V g_alpha_here = T * along - remaining / (1.0f - a);
          V g_distance = masked(ray.raw < ALPHA_MAX, a * g_alpha_here * -0.5f);
          V g_num = g_distance * ray.inverse, g_den = -(g_num * ray.distance);
          V x = g_num * dy;
          num += g_num, num_y += x, num_yy += x * dy;
          x = g_den * dy;
          den += g_den, den_y += x, den_yy += x * dy;
          distance += g_distance;
          s0 += w * g0, s1 += w * g1, s2 += w * g2, s3 += w * g3, s4 += w * g4;
          s5 += w * g5, s6 += w * g6, s7 += w * g7, s8 += w * g8;
        }
        if (!reached) continue;
        hit = true;
        V x = num * dx, y = den * dx;
        total[0] += sums(x, x * dx, num_y, num_y * dx);
        total[1] += sums(num_yy, den, y, y * dx);
        total[2] += sums(den_y, den_y * dx, den_yy, distance);
        total[3] += sums(s0, s1, s2, s3);
        total[4] += sums(s4, s5, s6, s7);
        total[5] += sums(s8, zero, zero, zero);
      }
      if (!hit) {
        memset(out, 0, VALUES * sizeof(float));
      } else {
        const float num_x = total[0][0], num_xx = total[0][1], num_y = total[0][2];
        const float num_xy = total[0][3], num_yy = total[1][0], den = total[1][1];
        const float den_x = total[1][2], den_xx = total[1][3], den_y = total[2][0];
        const float den_xy = total[2][1], den_yy = total[2][2], distance = total[2][3];
        out[0] = -(2.0f * (q[2] * num_x + q[5] * den + q[7] * den_x) + q[3] * num_y + q[8] * den_y);
        out[1] = -(2.0f * (q[4] * num_y + q[6] * den + q[9] * den_y) + q[3] * num_x + q[8] * den_x);
        out[2] = num_xx, out[3] = num_xy, out[4] = num_yy;
        out[5] = 2.0f * den_x, out[6] = 2.0f * den_y;
        out[7] = den_xx, out[8] = den_xy, out[9] = den_yy;
        out[10] = 0.0f, out[11] = -2.0f * distance / q[11], out[12] = 0.0f;
        memcpy(out + 13, &total[3], 9 * sizeof(float));
        out[22] = 0.0f, out[23] = 0.0f;
      }
      if ((k & 15) == 15)
        for (int row = 0; row < TILE; row++) {
          const V *T = (const V *)(m + row * TILE);
          bool some = false;
          for (int half = 0; half < HALVES; half++) some |= any(T[half] >= T_MIN);
          if (!some) live &= ~(1u << row);
        }
    }
  }
}

void sum_pairs(int64_t first, int64_t end, const float *pairs, const int64_t *offsets,
               float *gradients) {
  for (int64_t i = first; i < end; i++) {
    V4 total[VALUES / 4] = {};
    for (int64_t slot = offsets[i]; slot < offsets[i + 1]; slot++) {
      const V4 *row = (const V4 *)(pairs + slot * VALUES);
      for (int k = 0; k < VALUES / 4; k++) total[k] += row[k];
    }
    memcpy(gradients + i * VALUES, total, sizeof total);
  }
}

}  // extern "C"
