// Vec: LANES floats in one register of the instruction set of this build, with the elementary functions of the
// fused loss and the fused decode. All functions are inline; their symbols stay inside the shared library.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(__AVX2__) || defined(__AVX512F__)
#include <immintrin.h>
#endif

namespace se {

#if defined(__AVX512F__)
constexpr int LANES = 16;
struct Vec {
  __m512 v;
};
inline Vec load(const float* p) { return {_mm512_loadu_ps(p)}; }
inline void store(float* p, Vec a) { _mm512_storeu_ps(p, a.v); }
inline Vec broadcast(float x) { return {_mm512_set1_ps(x)}; }
inline Vec operator+(Vec a, Vec b) { return {_mm512_add_ps(a.v, b.v)}; }
inline Vec operator-(Vec a, Vec b) { return {_mm512_sub_ps(a.v, b.v)}; }
inline Vec operator*(Vec a, Vec b) { return {_mm512_mul_ps(a.v, b.v)}; }
inline Vec operator/(Vec a, Vec b) { return {_mm512_div_ps(a.v, b.v)}; }
inline Vec fma(Vec a, Vec b, Vec c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }  // a b + c
// The maskz forms compile to the plain instructions. GCC 12 warns about its own headers for some of the plain
// forms.
inline Vec max(Vec a, Vec b) { return {_mm512_maskz_max_ps(0xffff, a.v, b.v)}; }
inline Vec min(Vec a, Vec b) { return {_mm512_maskz_min_ps(0xffff, a.v, b.v)}; }
inline Vec select_greater(Vec a, Vec b, Vec yes, Vec no) {
  return {_mm512_mask_blend_ps(_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ), no.v, yes.v)};
}
inline Vec square_root(Vec a) { return {_mm512_sqrt_ps(a.v)}; }
inline Vec load_part(const float* p, int n) { return {_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << n) - 1), p)}; }
inline void store_part(float* p, Vec a, int n) { _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << n) - 1), a.v); }
inline uint32_t find_positive(Vec a) { return _mm512_cmp_ps_mask(a.v, _mm512_setzero_ps(), _CMP_GT_OQ); }
inline Vec round_to_nearest(Vec a) { return {_mm512_maskz_roundscale_ps(0xffff, a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)}; }
inline Vec scale_by_power_of_two(Vec a, Vec n) { return {_mm512_maskz_scalef_ps(0xffff, a.v, n.v)}; }  // n: integers
inline float sum(Vec a) {
  const __m256 high = _mm256_castpd_ps(_mm512_maskz_extractf64x4_pd(0xf, _mm512_castps_pd(a.v), 1));
  const __m256 o = _mm256_add_ps(_mm512_castps512_ps256(a.v), high);
  const __m128 h = _mm_add_ps(_mm256_castps256_ps128(o), _mm256_extractf128_ps(o, 1));
  const __m128 q = _mm_add_ps(h, _mm_movehl_ps(h, h));
  return _mm_cvtss_f32(_mm_add_ss(q, _mm_movehdup_ps(q)));
}
#elif defined(__AVX2__)
constexpr int LANES = 8;
struct Vec {
  __m256 v;
};
inline Vec load(const float* p) { return {_mm256_loadu_ps(p)}; }
inline void store(float* p, Vec a) { _mm256_storeu_ps(p, a.v); }
inline Vec broadcast(float x) { return {_mm256_set1_ps(x)}; }
inline Vec operator+(Vec a, Vec b) { return {_mm256_add_ps(a.v, b.v)}; }
inline Vec operator-(Vec a, Vec b) { return {_mm256_sub_ps(a.v, b.v)}; }
inline Vec operator*(Vec a, Vec b) { return {_mm256_mul_ps(a.v, b.v)}; }
inline Vec operator/(Vec a, Vec b) { return {_mm256_div_ps(a.v, b.v)}; }
inline Vec fma(Vec a, Vec b, Vec c) { return {_mm256_fmadd_ps(a.v, b.v, c.v)}; }
inline Vec max(Vec a, Vec b) { return {_mm256_max_ps(a.v, b.v)}; }
inline Vec min(Vec a, Vec b) { return {_mm256_min_ps(a.v, b.v)}; }
inline Vec select_greater(Vec a, Vec b, Vec yes, Vec no) { return {_mm256_blendv_ps(no.v, yes.v, _mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ))}; }
inline Vec square_root(Vec a) { return {_mm256_sqrt_ps(a.v)}; }
inline __m256i first_lanes(int n) { return _mm256_cmpgt_epi32(_mm256_set1_epi32(n), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7)); }
inline Vec load_part(const float* p, int n) { return {_mm256_maskload_ps(p, first_lanes(n))}; }
inline void store_part(float* p, Vec a, int n) { _mm256_maskstore_ps(p, first_lanes(n), a.v); }
inline uint32_t find_positive(Vec a) {
  return static_cast<uint32_t>(_mm256_movemask_ps(_mm256_cmp_ps(a.v, _mm256_setzero_ps(), _CMP_GT_OQ)));
}
inline Vec round_to_nearest(Vec a) { return {_mm256_round_ps(a.v, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC)}; }
inline Vec scale_by_power_of_two(Vec a, Vec n) {
  return {
      _mm256_mul_ps(a.v, _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(n.v), _mm256_set1_epi32(127)), 23)))};
}
inline float sum(Vec a) {
  const __m128 h = _mm_add_ps(_mm256_castps256_ps128(a.v), _mm256_extractf128_ps(a.v, 1));
  const __m128 q = _mm_add_ps(h, _mm_movehl_ps(h, h));
  return _mm_cvtss_f32(_mm_add_ss(q, _mm_movehdup_ps(q)));
}
#elif defined(__GNUC__)
constexpr int LANES = 4;  // 16 bytes: SSE2, NEON
typedef float F32x4 __attribute__((vector_size(16)));
typedef int32_t I32x4 __attribute__((vector_size(16)));
struct Vec {
  F32x4 v;
};
inline Vec load(const float* p) {
  Vec a;
  std::memcpy(&a.v, p, 16);
  return a;
}
inline void store(float* p, Vec a) { std::memcpy(p, &a.v, 16); }
inline Vec broadcast(float x) { return {F32x4{x, x, x, x}}; }
inline Vec operator+(Vec a, Vec b) { return {a.v + b.v}; }
inline Vec operator-(Vec a, Vec b) { return {a.v - b.v}; }
inline Vec operator*(Vec a, Vec b) { return {a.v * b.v}; }
inline Vec operator/(Vec a, Vec b) { return {a.v / b.v}; }
inline Vec fma(Vec a, Vec b, Vec c) { return {a.v * b.v + c.v}; }
inline Vec max(Vec a, Vec b) { return {a.v > b.v ? a.v : b.v}; }
inline Vec min(Vec a, Vec b) { return {a.v < b.v ? a.v : b.v}; }
inline Vec select_greater(Vec a, Vec b, Vec yes, Vec no) { return {a.v > b.v ? yes.v : no.v}; }
inline Vec square_root(Vec a) { return {F32x4{std::sqrt(a.v[0]), std::sqrt(a.v[1]), std::sqrt(a.v[2]), std::sqrt(a.v[3])}}; }
inline Vec load_part(const float* p, int n) {
  Vec a = broadcast(0.f);
  for (int i = 0; i < n; ++i) a.v[i] = p[i];
  return a;
}
inline void store_part(float* p, Vec a, int n) {
  for (int i = 0; i < n; ++i) p[i] = a.v[i];
}
inline uint32_t find_positive(Vec a) { return (a.v[0] > 0) | (a.v[1] > 0) << 1 | (a.v[2] > 0) << 2 | (a.v[3] > 0) << 3; }
inline Vec round_to_nearest(Vec a) {
  const F32x4 magic = {12582912.f, 12582912.f, 12582912.f, 12582912.f};  // 1.5 2^23: adding it rounds to an integer
  return {(a.v + magic) - magic};
}
inline Vec scale_by_power_of_two(Vec a, Vec n) {
  const I32x4 bits = (__builtin_convertvector(n.v, I32x4) + 127) << 23;
  F32x4 power;
  std::memcpy(&power, &bits, 16);
  return {a.v * power};
}
inline float sum(Vec a) { return (a.v[0] + a.v[2]) + (a.v[1] + a.v[3]); }
#else
constexpr int LANES = 1;
struct Vec {
  float v;
};
inline Vec load(const float* p) { return {*p}; }
inline void store(float* p, Vec a) { *p = a.v; }
inline Vec broadcast(float x) { return {x}; }
inline Vec operator+(Vec a, Vec b) { return {a.v + b.v}; }
inline Vec operator-(Vec a, Vec b) { return {a.v - b.v}; }
inline Vec operator*(Vec a, Vec b) { return {a.v * b.v}; }
inline Vec operator/(Vec a, Vec b) { return {a.v / b.v}; }
inline Vec fma(Vec a, Vec b, Vec c) { return {a.v * b.v + c.v}; }
inline Vec max(Vec a, Vec b) { return {a.v > b.v ? a.v : b.v}; }
inline Vec min(Vec a, Vec b) { return {a.v < b.v ? a.v : b.v}; }
inline Vec select_greater(Vec a, Vec b, Vec yes, Vec no) { return a.v > b.v ? yes : no; }
inline Vec square_root(Vec a) { return {std::sqrt(a.v)}; }
inline Vec load_part(const float* p, int n) { return {n ? *p : 0.f}; }
inline void store_part(float* p, Vec a, int n) {
  if (n) *p = a.v;
}
inline uint32_t find_positive(Vec a) { return a.v > 0; }
inline Vec round_to_nearest(Vec a) { return {std::nearbyint(a.v)}; }
inline Vec scale_by_power_of_two(Vec a, Vec n) { return {std::ldexp(a.v, static_cast<int>(n.v))}; }
inline float sum(Vec a) { return a.v; }
#endif

// load_part and store_part access only the first n < LANES values and set the others to zero. find_positive
// returns one bit per lane.

// e^x with an error of 2 ulp, x clamped to [-87, 87]. max and min return their second operand if one is NaN, so
// NaN stays NaN.
inline Vec exponential(Vec x) {
  x = min(broadcast(87.f), max(broadcast(-87.f), x));
  const Vec n = round_to_nearest(x * broadcast(1.44269504088896f));
  Vec r = fma(n, broadcast(-0.693145751953125f), x);
  r = fma(n, broadcast(-1.42860682e-6f), r);
  // (e^r - 1 - r) / r^2 on |r| <= ln 2 / 2: weighted least squares on Chebyshev nodes, relative error of e^r
  // 4e-9
  Vec p = fma(broadcast(0.0013751150f), r, broadcast(0.0083689876f));
  p = fma(p, r, broadcast(0.0416695438f));
  p = fma(p, r, broadcast(0.1666651815f));
  p = fma(p, r, broadcast(0.4999998808f));
  return scale_by_power_of_two(fma(p, r * r, r) + broadcast(1.f), n);
}

inline Vec sigmoid(Vec x) { return broadcast(1.f) / (broadcast(1.f) + exponential(broadcast(0.f) - x)); }

// tanh with a small relative error near 0 too, where its sign decides whether a Gaussian is drawn.
inline Vec tanh(Vec x) {
  const Vec z = x * x;
  // (tanh(x) / x - 1) / x^2 on |x| <= 0.625, fitted in the same way, relative error of tanh 2e-10
  Vec p = fma(broadcast(0.0021428037f), z, broadcast(-0.0081770932f));
  p = fma(p, z, broadcast(0.0217005014f));
  p = fma(p, z, broadcast(-0.0539467037f));
  p = fma(p, z, broadcast(0.1333320588f));
  p = fma(p, z, broadcast(-0.3333333135f));
  const Vec small = fma(p * z, x, x);
  const Vec large = broadcast(1.f) - broadcast(2.f) / (broadcast(1.f) + exponential(x + x));
  return select_greater(z, broadcast(0.390625f), large, small);
}

inline int round_up(int n, int multiple) { return (n + multiple - 1) / multiple * multiple; }

}  // namespace se
