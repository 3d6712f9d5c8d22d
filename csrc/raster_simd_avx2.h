// F32x16 in two AVX2 registers; raster_simd.h describes the functions.
#pragma once
#include <immintrin.h>

#include <cstdint>

#include "raster_packing.h"

namespace se {

constexpr int kInterleaved = 1;  // more would need too many registers

struct F32x16 {
  __m256 lo, hi;
};
struct Mask16 {
  __m256 lo, hi;
};

inline F32x16 load(const float* p) { return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)}; }
inline void store(float* p, F32x16 a) {
  _mm256_storeu_ps(p, a.lo);
  _mm256_storeu_ps(p + 8, a.hi);
}
inline F32x16 broadcast(float x) { return {_mm256_set1_ps(x), _mm256_set1_ps(x)}; }
inline F32x16 broadcast4(const float* p) {
  const __m256 v = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(p));
  return {v, v};
}
#define SE_BOTH(name, op) \
  inline F32x16 name(F32x16 a, F32x16 b) { return {op(a.lo, b.lo), op(a.hi, b.hi)}; }
SE_BOTH(operator+, _mm256_add_ps)
SE_BOTH(operator-, _mm256_sub_ps)
SE_BOTH(operator*, _mm256_mul_ps)
SE_BOTH(operator/, _mm256_div_ps)
SE_BOTH(min, _mm256_min_ps)
SE_BOTH(max, _mm256_max_ps)
#undef SE_BOTH
inline F32x16 fma(F32x16 a, F32x16 b, F32x16 c) { return {_mm256_fmadd_ps(a.lo, b.lo, c.lo), _mm256_fmadd_ps(a.hi, b.hi, c.hi)}; }
inline F32x16 fnma(F32x16 a, F32x16 b, F32x16 c) { return {_mm256_fnmadd_ps(a.lo, b.lo, c.lo), _mm256_fnmadd_ps(a.hi, b.hi, c.hi)}; }
inline F32x16 sqrt(F32x16 a) { return {_mm256_sqrt_ps(a.lo), _mm256_sqrt_ps(a.hi)}; }
inline F32x16 ceil(F32x16 a) { return {_mm256_ceil_ps(a.lo), _mm256_ceil_ps(a.hi)}; }
inline F32x16 floor(F32x16 a) { return {_mm256_floor_ps(a.lo), _mm256_floor_ps(a.hi)}; }
inline Mask16 ge(F32x16 a, F32x16 b) { return {_mm256_cmp_ps(a.lo, b.lo, _CMP_GE_OQ), _mm256_cmp_ps(a.hi, b.hi, _CMP_GE_OQ)}; }
inline Mask16 gt(F32x16 a, F32x16 b) { return {_mm256_cmp_ps(a.lo, b.lo, _CMP_GT_OQ), _mm256_cmp_ps(a.hi, b.hi, _CMP_GT_OQ)}; }
inline Mask16 operator&(Mask16 a, Mask16 b) { return {_mm256_and_ps(a.lo, b.lo), _mm256_and_ps(a.hi, b.hi)}; }
inline F32x16 select(Mask16 m, F32x16 a, F32x16 b) { return {_mm256_blendv_ps(b.lo, a.lo, m.lo), _mm256_blendv_ps(b.hi, a.hi, m.hi)}; }
inline F32x16 keep(Mask16 m, F32x16 a) { return {_mm256_and_ps(m.lo, a.lo), _mm256_and_ps(m.hi, a.hi)}; }
inline F32x16 mul_keep(Mask16 m, F32x16 a, F32x16 b) { return keep(m, a * b); }
inline F32x16 min_keep(Mask16 m, F32x16 a, F32x16 b) { return keep(m, min(a, b)); }
// sum[k] += weight * by[k] in the lanes of the mask.
inline void add_where(Mask16 m, F32x16 weight, const float* by, F32x16 (&sum)[4]) {
  const F32x16 kept = keep(m, weight);
  for (int k = 0; k < 4; ++k) sum[k] = fma(kept, broadcast(by[k]), sum[k]);
}
inline uint32_t bits(Mask16 m) { return static_cast<uint32_t>(_mm256_movemask_ps(m.lo) | _mm256_movemask_ps(m.hi) << 8); }
inline bool any(Mask16 m) { return _mm256_movemask_ps(_mm256_or_ps(m.lo, m.hi)) != 0; }
inline void store_int(int32_t* p, F32x16 a) {
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), _mm256_cvttps_epi32(a.lo));
  _mm256_storeu_si256(reinterpret_cast<__m256i*>(p + 8), _mm256_cvttps_epi32(a.hi));
}

// 2^p as a quintic on [-1/2, 1/2]. Adding 1.5 * 2^23 puts the nearest integer in the low bits of a float's
// mantissa.
struct Exp2 {
  static __m256 half(__m256 p) {
    const __m256 magic = _mm256_set1_ps(12582912.0f);
    const __m256 rounded = _mm256_add_ps(p, magic);
    const __m256 f = _mm256_sub_ps(p, _mm256_sub_ps(rounded, magic));
    __m256 q = _mm256_fmadd_ps(f, _mm256_set1_ps(1.3264738e-3f), _mm256_set1_ps(9.6715130e-3f));
    q = _mm256_fmadd_ps(f, q, _mm256_set1_ps(5.5507336e-2f));
    q = _mm256_fmadd_ps(f, q, _mm256_set1_ps(2.4022242e-1f));
    q = _mm256_fmadd_ps(f, q, _mm256_set1_ps(6.9314698e-1f));
    q = _mm256_fmadd_ps(f, q, _mm256_set1_ps(1.0f));
    return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(q), _mm256_slli_epi32(_mm256_castps_si256(rounded), 23)));
  }
  template <int N>
  void operator()(F32x16 (&p)[N]) const {
    for (int k = 0; k < N; ++k) p[k] = {half(p[k].lo), half(p[k].hi)};
  }
};

inline void split_exponent_half(__m256 a, __m256& m, __m256& e) {
  const __m256i b = _mm256_castps_si256(a);
  const __m256i shifted = _mm256_sub_epi32(b, _mm256_set1_epi32(0x3f400000));  // 0.75
  const __m256i k = _mm256_srai_epi32(shifted, 23);
  e = _mm256_cvtepi32_ps(k);
  m = _mm256_castsi256_ps(_mm256_sub_epi32(b, _mm256_slli_epi32(k, 23)));
}
// Load the first N of sixteen floats; the others are 0.
template <int N>
inline F32x16 load_first(const float* p) {
  static_assert(N == 7);
  return {_mm256_blend_ps(_mm256_loadu_ps(p), _mm256_setzero_ps(), 0x80), _mm256_setzero_ps()};
}

// Load sixteen floats; the first N are 0.
template <int N>
inline F32x16 load_from(const float* p) {
  static_assert(N == 7);
  return {_mm256_blend_ps(_mm256_setzero_ps(), _mm256_loadu_ps(p), 0x80), _mm256_loadu_ps(p + 8)};
}

// Store the first halves of a and b, then the second halves.
inline void store_halves(float* p, F32x16 a, F32x16 b) {
  _mm256_storeu_ps(p, a.lo), _mm256_storeu_ps(p + 8, b.lo);
  _mm256_storeu_ps(p + 16, a.hi), _mm256_storeu_ps(p + 24, b.hi);
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
  split_exponent_half(a.lo, m.lo, e.lo);
  split_exponent_half(a.hi, m.hi, e.hi);
}

inline void load_pairs(const float* const (&p)[16], F32x16& first, F32x16& second) {
  const auto four = [&](int k) {
    const auto two = [&](int j) {
      const __m128i low = _mm_loadl_epi64(reinterpret_cast<const __m128i_u*>(p[j]));  // aligned to four bytes only
      return _mm_loadh_pd(_mm_castsi128_pd(low), reinterpret_cast<const double*>(p[j + 1]));
    };
    return _mm256_castpd_ps(_mm256_insertf128_pd(_mm256_castpd128_pd256(two(k)), two(k + 2), 1));
  };
  const auto half = [&](int k, __m256& even, __m256& odd) {
    const __m256 a = four(k), b = four(k + 4);
    const auto in_order = [](__m256 v) { return _mm256_castpd_ps(_mm256_permute4x64_pd(_mm256_castps_pd(v), 0xd8)); };
    even = in_order(_mm256_shuffle_ps(a, b, 0x88));
    odd = in_order(_mm256_shuffle_ps(a, b, 0xdd));
  };
  half(0, first.lo, second.lo);
  half(8, first.hi, second.hi);
}

// Sixteen lanes are four quarters of four. column<C>: lane C of each quarter in all its lanes.
template <int C>
inline F32x16 column(F32x16 a) {
  return {_mm256_permute_ps(a.lo, C * 0x55), _mm256_permute_ps(a.hi, C * 0x55)};
}
// Transpose each quarter of four values as a 4 x 4 matrix.
inline void transpose4(F32x16 (&r)[4]) {
  const auto half = [](__m256& w, __m256& x, __m256& y, __m256& z) {
    const __m256 a = _mm256_unpacklo_ps(w, x), b = _mm256_unpackhi_ps(w, x), c = _mm256_unpacklo_ps(y, z), d = _mm256_unpackhi_ps(y, z);
    w = _mm256_shuffle_ps(a, c, 0x44), x = _mm256_shuffle_ps(a, c, 0xee), y = _mm256_shuffle_ps(b, d, 0x44),
    z = _mm256_shuffle_ps(b, d, 0xee);
  };
  half(r[0].lo, r[1].lo, r[2].lo, r[3].lo);
  half(r[0].hi, r[1].hi, r[2].hi, r[3].hi);
}
// Quarter q of value j becomes quarter j of value q.
inline void transpose_quarters(F32x16 (&r)[4]) {
  const auto first = [](__m256 a, __m256 b) { return _mm256_permute2f128_ps(a, b, 0x20); };
  const auto second = [](__m256 a, __m256 b) { return _mm256_permute2f128_ps(a, b, 0x31); };
  const F32x16 a = r[0], b = r[1], c = r[2], d = r[3];
  r[0] = {first(a.lo, b.lo), first(c.lo, d.lo)}, r[1] = {second(a.lo, b.lo), second(c.lo, d.lo)};
  r[2] = {first(a.hi, b.hi), first(c.hi, d.hi)}, r[3] = {second(a.hi, b.hi), second(c.hi, d.hi)};
}
// Quarter j of the result is the sum of the quarters of value j.
inline F32x16 sum_quarters(const F32x16 (&r)[4]) {
  const auto pair = [](F32x16 a, F32x16 b) {
    const __m256 x = _mm256_add_ps(a.lo, a.hi), y = _mm256_add_ps(b.lo, b.hi);
    return _mm256_add_ps(_mm256_permute2f128_ps(x, y, 0x20), _mm256_permute2f128_ps(x, y, 0x31));
  };
  return {pair(r[0], r[1]), pair(r[2], r[3])};
}

inline void transpose8(__m256 (&r)[8]) {
  __m256 t[8], s[8];
  for (int i = 0; i < 4; ++i) {
    t[2 * i] = _mm256_unpacklo_ps(r[2 * i], r[2 * i + 1]);
    t[2 * i + 1] = _mm256_unpackhi_ps(r[2 * i], r[2 * i + 1]);
  }
  for (int i = 0; i < 2; ++i)
    for (int h = 0; h < 2; ++h) {
      s[4 * i + 2 * h] = _mm256_shuffle_ps(t[4 * i + h], t[4 * i + 2 + h], 0x44);
      s[4 * i + 2 * h + 1] = _mm256_shuffle_ps(t[4 * i + h], t[4 * i + 2 + h], 0xee);
    }
  for (int k = 0; k < 4; ++k) {
    r[k] = _mm256_permute2f128_ps(s[k], s[4 + k], 0x20);
    r[4 + k] = _mm256_permute2f128_ps(s[k], s[4 + k], 0x31);
  }
}

inline void transpose(F32x16 (&r)[16]) {
  __m256 a[8], b[8], c[8], d[8];
  for (int i = 0; i < 8; ++i) a[i] = r[i].lo, b[i] = r[i].hi, c[i] = r[8 + i].lo, d[i] = r[8 + i].hi;
  transpose8(a);
  transpose8(b);
  transpose8(c);
  transpose8(d);
  for (int i = 0; i < 8; ++i) r[i] = {a[i], c[i]}, r[8 + i] = {b[i], d[i]};
}

}  // namespace se
