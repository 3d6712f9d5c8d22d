// The vector type of the rasteriser. F32x16 is sixteen floats: the 4 x 4 pixels of a block or sixteen Gaussians;
// Mask16 is its mask. Each instruction set implements the same functions (in one register, two or four), so that
// the algorithms are written once:
//   load store broadcast broadcast4 (four floats, repeated), + - * /, fma(a, b, c) = a b + c, fnma = c - a b, min max sqrt ceil floor,
//   ge gt &, select(m, a, b), keep(m, a) = a or 0, mul_keep, min_keep, bits any, store_int (truncates),
//   Exp2 (relative error below 4e-7; undefined for p < -126), split_exponent, transpose (16 x 16),
//   load_pairs(p, a, b): a = p[0][0] p[1][0] ..., b = p[0][1] p[1][1] ...
#pragma once
#include <cstdint>

// Select four of the eight lanes of two vectors.
#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define SE_SHUFFLE __builtin_shufflevector
#endif
#endif
#ifndef SE_SHUFFLE  // GCC before 12
#define SE_SHUFFLE(a, b, ...) __builtin_shuffle(a, b, (int32_t __attribute__((vector_size(16)))){__VA_ARGS__})
#endif

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512BW__)
#include "raster_simd_avx512.h"
#elif defined(__AVX2__) && defined(__FMA__)
#include "raster_simd_avx2.h"
#else
#include "raster_simd_portable.h"
#endif

namespace se {

inline F32x16 at_lane(int lane, float x) {
  alignas(64) float all[16] = {};
  all[lane] = x;
  return load(all);
}

// log2(a) for normal a > 0; the absolute error is about one rounding of the result.
inline F32x16 log2(F32x16 a) {
  F32x16 m, e;
  split_exponent(a, m, e);
  const F32x16 one = broadcast(1.0f), s = (m - one) / (m + one), s2 = s * s;  // log2 m = 2 / ln 2 * atanh s, |s| <= 0.2
  F32x16 q = fma(s2, broadcast(0.43905754f), broadcast(0.57639673f));
  q = fma(s2, q, broadcast(0.96180218f));
  q = fma(s2, q, broadcast(2.88539007f));
  return fma(s, q, e);
}

}  // namespace se
