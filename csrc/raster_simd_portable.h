// Sixteen floats in four 16-byte vectors of the compiler (SSE2, NEON); see raster_simd.h for what each function promises.
#pragma once
#include <cmath>
#include <cstdint>
#include "raster_packing.h"
#include <cstring>
#if defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace se {

typedef float V4 __attribute__((vector_size(16)));
typedef int32_t I4 __attribute__((vector_size(16)));

constexpr int kSideBySide = 1;  // there are too few registers for more

struct F16 {
  V4 v[4];
};
struct M16 {
  I4 v[4];
};

#define SE_EACH for (int i = 0; i < 4; ++i)
inline F16 load(const float* p) {
  F16 r;
  std::memcpy(&r, p, 64);
  return r;
}
inline void store(float* p, F16 a) { std::memcpy(p, &a, 64); }
inline F16 bcast(float x) {
  const V4 v = {x, x, x, x};
  return {{v, v, v, v}};
}
inline F16 bcast4(const float* p) {
  V4 v;
  std::memcpy(&v, p, 16);
  return {{v, v, v, v}};
}
#define SE_ALL(T, expression) \
  T r;                        \
  SE_EACH r.v[i] = expression; \
  return r
inline F16 operator+(F16 a, F16 b) { SE_ALL(F16, a.v[i] + b.v[i]); }
inline F16 operator-(F16 a, F16 b) { SE_ALL(F16, a.v[i] - b.v[i]); }
inline F16 operator*(F16 a, F16 b) { SE_ALL(F16, a.v[i] * b.v[i]); }
inline F16 operator/(F16 a, F16 b) { SE_ALL(F16, a.v[i] / b.v[i]); }
#if defined(__aarch64__)
inline V4 fma4(V4 a, V4 b, V4 c) { return (V4)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b); }
inline V4 fnma4(V4 a, V4 b, V4 c) { return (V4)vfmsq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b); }
inline V4 sqrt4(V4 a) { return (V4)vsqrtq_f32((float32x4_t)a); }
inline V4 ceil4(V4 a) { return (V4)vrndpq_f32((float32x4_t)a); }
inline V4 floor4(V4 a) { return (V4)vrndmq_f32((float32x4_t)a); }
inline bool any4(I4 a) { return vmaxvq_u32((uint32x4_t)a) != 0; }
inline uint32_t sum4(I4 a) { return vaddvq_u32((uint32x4_t)a); }
#else
inline V4 fma4(V4 a, V4 b, V4 c) { return a * b + c; }
inline V4 fnma4(V4 a, V4 b, V4 c) { return c - a * b; }
inline V4 sqrt4(V4 a) { return V4{__builtin_sqrtf(a[0]), __builtin_sqrtf(a[1]), __builtin_sqrtf(a[2]), __builtin_sqrtf(a[3])}; }
inline V4 ceil4(V4 a) { return V4{__builtin_ceilf(a[0]), __builtin_ceilf(a[1]), __builtin_ceilf(a[2]), __builtin_ceilf(a[3])}; }
inline V4 floor4(V4 a) { return V4{__builtin_floorf(a[0]), __builtin_floorf(a[1]), __builtin_floorf(a[2]), __builtin_floorf(a[3])}; }
inline bool any4(I4 a) { return (a[0] | a[1] | a[2] | a[3]) != 0; }
inline uint32_t sum4(I4 a) { return static_cast<uint32_t>(a[0] + a[1] + a[2] + a[3]); }
#endif
inline F16 fma(F16 a, F16 b, F16 c) { SE_ALL(F16, fma4(a.v[i], b.v[i], c.v[i])); }
inline F16 fnma(F16 a, F16 b, F16 c) { SE_ALL(F16, fnma4(a.v[i], b.v[i], c.v[i])); }
inline F16 min(F16 a, F16 b) { SE_ALL(F16, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
inline F16 max(F16 a, F16 b) { SE_ALL(F16, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
inline M16 ge(F16 a, F16 b) { SE_ALL(M16, a.v[i] >= b.v[i]); }
inline M16 gt(F16 a, F16 b) { SE_ALL(M16, a.v[i] > b.v[i]); }
inline M16 operator&(M16 a, M16 b) { SE_ALL(M16, a.v[i] & b.v[i]); }
inline F16 select(M16 m, F16 a, F16 b) { SE_ALL(F16, (V4)((m.v[i] & (I4)a.v[i]) | (~m.v[i] & (I4)b.v[i]))); }
inline F16 keep(M16 m, F16 a) { SE_ALL(F16, (V4)(m.v[i] & (I4)a.v[i])); }
inline F16 mul_keep(M16 m, F16 a, F16 b) { return keep(m, a * b); }
inline F16 min_keep(M16 m, F16 a, F16 b) { return keep(m, min(a, b)); }
inline F16 sqrt(F16 a) { SE_ALL(F16, sqrt4(a.v[i])); }
inline F16 ceil(F16 a) { SE_ALL(F16, ceil4(a.v[i])); }
inline F16 floor(F16 a) { SE_ALL(F16, floor4(a.v[i])); }
// sum[k] += weight * by[k] in the lanes of the mask.
inline void add_where(M16 m, F16 weight, const float* by, F16 (&sum)[4]) {
  const F16 kept = keep(m, weight);
  for (int k = 0; k < 4; ++k) sum[k] = fma(kept, bcast(by[k]), sum[k]);
}
inline uint32_t bits(M16 m) {
  const I4 weight = {1 << 0, 1 << 1, 1 << 2, 1 << 3};
  I4 all = m.v[0] & weight;
  for (int i = 1; i < 4; ++i) all |= m.v[i] & (weight << 4 * i);
  return sum4(all);
}
inline bool any(M16 m) { return any4((m.v[0] | m.v[1]) | (m.v[2] | m.v[3])); }
inline void store_int(int32_t* p, F16 a) {
  for (int k = 0; k < 16; ++k) p[k] = static_cast<int32_t>(a.v[k / 4][k % 4]);
}

// 2^p as a quintic on [-1/2, 1/2]; 1.5 * 2^23 puts the nearest integer in the low bits of a float's mantissa.
struct Exp2 {
  static F16 single(F16 p) {
    const F16 magic = bcast(12582912.0f);
    const F16 rounded = p + magic, f = p - (rounded - magic);
    F16 q = fma(f, bcast(1.3264738e-3f), bcast(9.6715130e-3f));
    q = fma(f, q, bcast(5.5507336e-2f));
    q = fma(f, q, bcast(2.4022242e-1f));
    q = fma(f, q, bcast(6.9314698e-1f));
    q = fma(f, q, bcast(1.0f));
    SE_ALL(F16, (V4)((I4)q.v[i] + ((I4)rounded.v[i] << 23)));
  }
  template <int N>
  void operator()(F16 (&p)[N]) const {
    for (int k = 0; k < N; ++k) p[k] = single(p[k]);
  }
};

// The first N of sixteen floats, the others 0.
template <int N>
inline F16 load_first(const float* p) {
  float all[16] = {};
  std::memcpy(all, p, N * sizeof(float));
  return load(all);
}

// Sixteen floats, the first N of them taken as 0.
template <int N>
inline F16 load_from(const float* p) {
  F16 r = load(p);
  for (int k = 0; k < N; ++k) r.v[k / 4][k % 4] = 0;
  return r;
}

// First halves of a and b, then second halves.
inline void store_halves(float* p, F16 a, F16 b) {
  std::memcpy(p, &a.v[0], 32), std::memcpy(p + 8, &b.v[0], 32);
  std::memcpy(p + 16, &a.v[2], 32), std::memcpy(p + 24, &b.v[2], 32);
}

// Sixteen rows of three floats as three columns.
inline void load3(const float* p, F16& a, F16& b, F16& c) {
  alignas(64) float column[3][16];
  for (int i = 0; i < 16; ++i)
    for (int k = 0; k < 3; ++k) column[k][i] = p[3 * i + k];
  a = load(column[0]), b = load(column[1]), c = load(column[2]);
}

// Columns of sixteen rows, one row after the other.
template <int N>
inline void interleave(F16 (&r)[N]) {
  alignas(64) float column[N][16], row[16 * N];
  for (int k = 0; k < N; ++k) store(column[k], r[k]);
  for (int i = 0; i < 16; ++i)
    for (int k = 0; k < N; ++k) row[N * i + k] = column[k][i];
  for (int k = 0; k < N; ++k) r[k] = load(row + 16 * k);
}
inline void interleave2(F16 (&r)[2]) { interleave(r); }
inline void interleave3(F16 (&r)[3]) { interleave(r); }

// a = m * 2^e with m in [0.75, 1.5)
inline void split_exponent(F16 a, F16& m, F16& e) {
  SE_EACH {
    const I4 b = (I4)a.v[i], k = (b - 0x3f400000) >> 23;
    for (int j = 0; j < 4; ++j) e.v[i][j] = static_cast<float>(k[j]);
    m.v[i] = (V4)(b - (k << 23));
  }
}

inline void load_pairs(const float* const (&p)[16], F16& first, F16& second) {
  for (int k = 0; k < 16; ++k) first.v[k / 4][k % 4] = p[k][0], second.v[k / 4][k % 4] = p[k][1];
}

// Sixteen lanes are four quarters of four. Column<C>: lane C of each quarter in all its lanes.
template <int C>
inline F16 column(F16 a) {
  SE_ALL(F16, (V4{a.v[i][C], a.v[i][C], a.v[i][C], a.v[i][C]}));
}
inline void transpose4(V4& w, V4& x, V4& y, V4& z) {
  const V4 a = SE_SHUFFLE(w, x, 0, 4, 1, 5), b = SE_SHUFFLE(w, x, 2, 6, 3, 7), c = SE_SHUFFLE(y, z, 0, 4, 1, 5), d = SE_SHUFFLE(y, z, 2, 6, 3, 7);
  w = SE_SHUFFLE(a, c, 0, 1, 4, 5), x = SE_SHUFFLE(a, c, 2, 3, 6, 7), y = SE_SHUFFLE(b, d, 0, 1, 4, 5), z = SE_SHUFFLE(b, d, 2, 3, 6, 7);
}
// Each quarter of four values, as a 4 x 4 matrix.
inline void transpose4(F16 (&r)[4]) { SE_EACH transpose4(r[0].v[i], r[1].v[i], r[2].v[i], r[3].v[i]); }
// Quarter q of value j becomes quarter j of value q.
inline void transpose_quarters(F16 (&r)[4]) {
  F16 t[4];
  for (int j = 0; j < 4; ++j)
    for (int q = 0; q < 4; ++q) t[q].v[j] = r[j].v[q];
  for (int q = 0; q < 4; ++q) r[q] = t[q];
}
// Quarter j of the result is the sum of value j's quarters.
inline F16 sum_quarters(const F16 (&a)[4]) { SE_ALL(F16, (a[i].v[0] + a[i].v[2]) + (a[i].v[1] + a[i].v[3])); }

inline void transpose(F16 (&r)[16]) {
  F16 t[16];
  for (int a = 0; a < 4; ++a)
    for (int b = 0; b < 4; ++b) {
      V4 w = r[4 * a].v[b], x = r[4 * a + 1].v[b], y = r[4 * a + 2].v[b], z = r[4 * a + 3].v[b];
      transpose4(w, x, y, z);
      t[4 * b].v[a] = w, t[4 * b + 1].v[a] = x, t[4 * b + 2].v[a] = y, t[4 * b + 3].v[a] = z;
    }
  for (int i = 0; i < 16; ++i) r[i] = t[i];
}
#undef SE_EACH
#undef SE_ALL

}  // namespace se
