// F32x16 in four 16-byte vectors of the compiler (SSE2, NEON); raster_simd.h describes the functions.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#include "raster_packing.h"
#if defined(__aarch64__)
#include <arm_neon.h>
#endif

namespace se {

typedef float F32x4 __attribute__((vector_size(16)));
typedef int32_t I32x4 __attribute__((vector_size(16)));

constexpr int kInterleaved = 1;  // more would need too many registers

struct F32x16 {
  F32x4 v[4];
};
struct Mask16 {
  I32x4 v[4];
};

#define SE_EACH for (int i = 0; i < 4; ++i)
inline F32x16 load(const float* p) {
  F32x16 r;
  std::memcpy(&r, p, 64);
  return r;
}
inline void store(float* p, F32x16 a) { std::memcpy(p, &a, 64); }
inline F32x16 broadcast(float x) {
  const F32x4 v = {x, x, x, x};
  return {{v, v, v, v}};
}
inline F32x16 broadcast4(const float* p) {
  F32x4 v;
  std::memcpy(&v, p, 16);
  return {{v, v, v, v}};
}
#define SE_ALL(T, expression)  \
  T r;                         \
  SE_EACH r.v[i] = expression; \
  return r
inline F32x16 operator+(F32x16 a, F32x16 b) { SE_ALL(F32x16, a.v[i] + b.v[i]); }
inline F32x16 operator-(F32x16 a, F32x16 b) { SE_ALL(F32x16, a.v[i] - b.v[i]); }
inline F32x16 operator*(F32x16 a, F32x16 b) { SE_ALL(F32x16, a.v[i] * b.v[i]); }
inline F32x16 operator/(F32x16 a, F32x16 b) { SE_ALL(F32x16, a.v[i] / b.v[i]); }
#if defined(__aarch64__)
inline F32x4 fma4(F32x4 a, F32x4 b, F32x4 c) { return (F32x4)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b); }
inline F32x4 fnma4(F32x4 a, F32x4 b, F32x4 c) { return (F32x4)vfmsq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b); }
inline F32x4 sqrt4(F32x4 a) { return (F32x4)vsqrtq_f32((float32x4_t)a); }
inline F32x4 ceil4(F32x4 a) { return (F32x4)vrndpq_f32((float32x4_t)a); }
inline F32x4 floor4(F32x4 a) { return (F32x4)vrndmq_f32((float32x4_t)a); }
inline bool any4(I32x4 a) { return vmaxvq_u32((uint32x4_t)a) != 0; }
inline uint32_t sum4(I32x4 a) { return vaddvq_u32((uint32x4_t)a); }
#else
inline F32x4 fma4(F32x4 a, F32x4 b, F32x4 c) { return a * b + c; }
inline F32x4 fnma4(F32x4 a, F32x4 b, F32x4 c) { return c - a * b; }
inline F32x4 sqrt4(F32x4 a) { return F32x4{__builtin_sqrtf(a[0]), __builtin_sqrtf(a[1]), __builtin_sqrtf(a[2]), __builtin_sqrtf(a[3])}; }
inline F32x4 ceil4(F32x4 a) { return F32x4{__builtin_ceilf(a[0]), __builtin_ceilf(a[1]), __builtin_ceilf(a[2]), __builtin_ceilf(a[3])}; }
inline F32x4 floor4(F32x4 a) {
  return F32x4{__builtin_floorf(a[0]), __builtin_floorf(a[1]), __builtin_floorf(a[2]), __builtin_floorf(a[3])};
}
inline bool any4(I32x4 a) { return (a[0] | a[1] | a[2] | a[3]) != 0; }
inline uint32_t sum4(I32x4 a) { return static_cast<uint32_t>(a[0] + a[1] + a[2] + a[3]); }
#endif
inline F32x16 fma(F32x16 a, F32x16 b, F32x16 c) { SE_ALL(F32x16, fma4(a.v[i], b.v[i], c.v[i])); }
inline F32x16 fnma(F32x16 a, F32x16 b, F32x16 c) { SE_ALL(F32x16, fnma4(a.v[i], b.v[i], c.v[i])); }
inline F32x16 min(F32x16 a, F32x16 b) { SE_ALL(F32x16, a.v[i] < b.v[i] ? a.v[i] : b.v[i]); }
inline F32x16 max(F32x16 a, F32x16 b) { SE_ALL(F32x16, a.v[i] > b.v[i] ? a.v[i] : b.v[i]); }
inline Mask16 ge(F32x16 a, F32x16 b) { SE_ALL(Mask16, a.v[i] >= b.v[i]); }
inline Mask16 gt(F32x16 a, F32x16 b) { SE_ALL(Mask16, a.v[i] > b.v[i]); }
inline Mask16 operator&(Mask16 a, Mask16 b) { SE_ALL(Mask16, a.v[i] & b.v[i]); }
inline F32x16 select(Mask16 m, F32x16 a, F32x16 b) { SE_ALL(F32x16, (F32x4)((m.v[i] & (I32x4)a.v[i]) | (~m.v[i] & (I32x4)b.v[i]))); }
inline F32x16 keep(Mask16 m, F32x16 a) { SE_ALL(F32x16, (F32x4)(m.v[i] & (I32x4)a.v[i])); }
inline F32x16 mul_keep(Mask16 m, F32x16 a, F32x16 b) { return keep(m, a * b); }
inline F32x16 min_keep(Mask16 m, F32x16 a, F32x16 b) { return keep(m, min(a, b)); }
inline F32x16 sqrt(F32x16 a) { SE_ALL(F32x16, sqrt4(a.v[i])); }
inline F32x16 ceil(F32x16 a) { SE_ALL(F32x16, ceil4(a.v[i])); }
inline F32x16 floor(F32x16 a) { SE_ALL(F32x16, floor4(a.v[i])); }
// sum[k] += weight * by[k] in the lanes of the mask.
inline void add_where(Mask16 m, F32x16 weight, const float* by, F32x16 (&sum)[4]) {
  const F32x16 kept = keep(m, weight);
  for (int k = 0; k < 4; ++k) sum[k] = fma(kept, broadcast(by[k]), sum[k]);
}
inline uint32_t bits(Mask16 m) {
  const I32x4 weight = {1 << 0, 1 << 1, 1 << 2, 1 << 3};
  I32x4 all = m.v[0] & weight;
  for (int i = 1; i < 4; ++i) all |= m.v[i] & (weight << 4 * i);
  return sum4(all);
}
inline bool any(Mask16 m) { return any4((m.v[0] | m.v[1]) | (m.v[2] | m.v[3])); }
inline void store_int(int32_t* p, F32x16 a) {
  for (int k = 0; k < 16; ++k) p[k] = static_cast<int32_t>(a.v[k / 4][k % 4]);
}

// 2^p as a quintic on [-1/2, 1/2]. Adding 1.5 * 2^23 puts the nearest integer in the low bits of a float's
// mantissa.
struct Exp2 {
  static F32x16 single(F32x16 p) {
    const F32x16 magic = broadcast(12582912.0f);
    const F32x16 rounded = p + magic, f = p - (rounded - magic);
    F32x16 q = fma(f, broadcast(1.3264738e-3f), broadcast(9.6715130e-3f));
    q = fma(f, q, broadcast(5.5507336e-2f));
    q = fma(f, q, broadcast(2.4022242e-1f));
    q = fma(f, q, broadcast(6.9314698e-1f));
    q = fma(f, q, broadcast(1.0f));
    SE_ALL(F32x16, (F32x4)((I32x4)q.v[i] + ((I32x4)rounded.v[i] << 23)));
  }
  template <int N>
  void operator()(F32x16 (&p)[N]) const {
    for (int k = 0; k < N; ++k) p[k] = single(p[k]);
  }
};

// Load the first N of sixteen floats; the others are 0.
template <int N>
inline F32x16 load_first(const float* p) {
  float all[16] = {};
  std::memcpy(all, p, N * sizeof(float));
  return load(all);
}

// Load sixteen floats; the first N are 0.
template <int N>
inline F32x16 load_from(const float* p) {
  F32x16 r = load(p);
  for (int k = 0; k < N; ++k) r.v[k / 4][k % 4] = 0;
  return r;
}

// Store the first halves of a and b, then the second halves.
inline void store_halves(float* p, F32x16 a, F32x16 b) {
  std::memcpy(p, &a.v[0], 32), std::memcpy(p + 8, &b.v[0], 32);
  std::memcpy(p + 16, &a.v[2], 32), std::memcpy(p + 24, &b.v[2], 32);
}

// Load sixteen rows of three floats as three columns.
inline void load3(const float* p, F32x16& a, F32x16& b, F32x16& c) {
  alignas(64) float column[3][16];
  for (int i = 0; i < 16; ++i)
    for (int k = 0; k < 3; ++k) column[k][i] = p[3 * i + k];
  a = load(column[0]), b = load(column[1]), c = load(column[2]);
}

// Turn columns of sixteen rows into consecutive rows.
template <int N>
inline void interleave(F32x16 (&r)[N]) {
  alignas(64) float column[N][16], row[16 * N];
  for (int k = 0; k < N; ++k) store(column[k], r[k]);
  for (int i = 0; i < 16; ++i)
    for (int k = 0; k < N; ++k) row[N * i + k] = column[k][i];
  for (int k = 0; k < N; ++k) r[k] = load(row + 16 * k);
}
inline void interleave2(F32x16 (&r)[2]) { interleave(r); }
inline void interleave3(F32x16 (&r)[3]) { interleave(r); }

// a = m * 2^e with m in [0.75, 1.5)
inline void split_exponent(F32x16 a, F32x16& m, F32x16& e) {
  SE_EACH {
    const I32x4 b = (I32x4)a.v[i], k = (b - 0x3f400000) >> 23;
    for (int j = 0; j < 4; ++j) e.v[i][j] = static_cast<float>(k[j]);
    m.v[i] = (F32x4)(b - (k << 23));
  }
}

inline void load_pairs(const float* const (&p)[16], F32x16& first, F32x16& second) {
  for (int k = 0; k < 16; ++k) first.v[k / 4][k % 4] = p[k][0], second.v[k / 4][k % 4] = p[k][1];
}

// Sixteen lanes are four quarters of four. column<C>: lane C of each quarter in all its lanes.
template <int C>
inline F32x16 column(F32x16 a) {
  SE_ALL(F32x16, (F32x4{a.v[i][C], a.v[i][C], a.v[i][C], a.v[i][C]}));
}
inline void transpose4(F32x4& w, F32x4& x, F32x4& y, F32x4& z) {
  const F32x4 a = SE_SHUFFLE(w, x, 0, 4, 1, 5), b = SE_SHUFFLE(w, x, 2, 6, 3, 7), c = SE_SHUFFLE(y, z, 0, 4, 1, 5),
              d = SE_SHUFFLE(y, z, 2, 6, 3, 7);
  w = SE_SHUFFLE(a, c, 0, 1, 4, 5), x = SE_SHUFFLE(a, c, 2, 3, 6, 7), y = SE_SHUFFLE(b, d, 0, 1, 4, 5), z = SE_SHUFFLE(b, d, 2, 3, 6, 7);
}
// Transpose each quarter of four values as a 4 x 4 matrix.
inline void transpose4(F32x16 (&r)[4]) { SE_EACH transpose4(r[0].v[i], r[1].v[i], r[2].v[i], r[3].v[i]); }
// Quarter q of value j becomes quarter j of value q.
inline void transpose_quarters(F32x16 (&r)[4]) {
  F32x16 t[4];
  for (int j = 0; j < 4; ++j)
    for (int q = 0; q < 4; ++q) t[q].v[j] = r[j].v[q];
  for (int q = 0; q < 4; ++q) r[q] = t[q];
}
// Quarter j of the result is the sum of the quarters of value j.
inline F32x16 sum_quarters(const F32x16 (&a)[4]) { SE_ALL(F32x16, (a[i].v[0] + a[i].v[2]) + (a[i].v[1] + a[i].v[3])); }

inline void transpose(F32x16 (&r)[16]) {
  F32x16 t[16];
  for (int a = 0; a < 4; ++a)
    for (int b = 0; b < 4; ++b) {
      F32x4 w = r[4 * a].v[b], x = r[4 * a + 1].v[b], y = r[4 * a + 2].v[b], z = r[4 * a + 3].v[b];
      transpose4(w, x, y, z);
      t[4 * b].v[a] = w, t[4 * b + 1].v[a] = x, t[4 * b + 2].v[a] = y, t[4 * b + 3].v[a] = z;
    }
  for (int i = 0; i < 16; ++i) r[i] = t[i];
}
#undef SE_EACH
#undef SE_ALL

}  // namespace se
