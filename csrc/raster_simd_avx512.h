// F32x16 in one AVX-512 register; raster_simd.h describes the functions.
#pragma once
#include <immintrin.h>

#include <cstdint>

namespace se {

constexpr int kInterleaved = 4;  // Gaussians whose exponentials are computed together

struct F32x16 {
  __m512 v;
};
struct Mask16 {
  __mmask16 m;
};

inline F32x16 load(const float* p) { return {_mm512_loadu_ps(p)}; }
inline void store(float* p, F32x16 a) { _mm512_storeu_ps(p, a.v); }
inline F32x16 broadcast(float x) { return {_mm512_set1_ps(x)}; }
inline F32x16 broadcast4(const float* p) { return {_mm512_broadcast_f32x4(_mm_loadu_ps(p))}; }
inline F32x16 operator+(F32x16 a, F32x16 b) { return {_mm512_add_ps(a.v, b.v)}; }
inline F32x16 operator-(F32x16 a, F32x16 b) { return {_mm512_sub_ps(a.v, b.v)}; }
inline F32x16 operator*(F32x16 a, F32x16 b) { return {_mm512_mul_ps(a.v, b.v)}; }
inline F32x16 operator/(F32x16 a, F32x16 b) { return {_mm512_div_ps(a.v, b.v)}; }
inline F32x16 fma(F32x16 a, F32x16 b, F32x16 c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
inline F32x16 fnma(F32x16 a, F32x16 b, F32x16 c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
inline F32x16 min(F32x16 a, F32x16 b) { return {_mm512_min_ps(a.v, b.v)}; }
inline F32x16 max(F32x16 a, F32x16 b) { return {_mm512_max_ps(a.v, b.v)}; }
inline F32x16 sqrt(F32x16 a) { return {_mm512_sqrt_ps(a.v)}; }
inline F32x16 ceil(F32x16 a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC)}; }
inline F32x16 floor(F32x16 a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)}; }
inline Mask16 ge(F32x16 a, F32x16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)}; }
inline Mask16 gt(F32x16 a, F32x16 b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)}; }
inline Mask16 operator&(Mask16 a, Mask16 b) { return {_kand_mask16(a.m, b.m)}; }
inline F32x16 select(Mask16 m, F32x16 a, F32x16 b) { return {_mm512_mask_blend_ps(m.m, b.v, a.v)}; }
inline F32x16 keep(Mask16 m, F32x16 a) { return {_mm512_maskz_mov_ps(m.m, a.v)}; }
inline F32x16 mul_keep(Mask16 m, F32x16 a, F32x16 b) { return {_mm512_maskz_mul_ps(m.m, a.v, b.v)}; }
inline F32x16 min_keep(Mask16 m, F32x16 a, F32x16 b) { return {_mm512_maskz_min_ps(m.m, a.v, b.v)}; }
// sum[k] += weight * by[k] in the lanes of the mask.
inline void add_where(Mask16 m, F32x16 weight, const float* by, F32x16 (&sum)[4]) {
  for (int k = 0; k < 4; ++k) sum[k].v = _mm512_mask3_fmadd_ps(weight.v, _mm512_set1_ps(by[k]), sum[k].v, m.m);
}
inline uint32_t bits(Mask16 m) { return m.m; }
inline bool any(Mask16 m) { return m.m != 0; }
inline void store_int(int32_t* p, F32x16 a) { _mm512_storeu_si512(p, _mm512_cvttps_epi32(a.v)); }

// 2^p: a table in a register for the nearest multiple of 1/16, and a quadratic for the rest. Adding 1.5 * 2^19
// puts the multiple in the low bits of a float's mantissa. The entries of the table make up for the exponent
// that these bits add.
struct Exp2 {
  __m512 table;
  Exp2() {
    alignas(64) int32_t entry[16];
    for (int i = 0; i < 16; ++i) {
      const float power = static_cast<float>(__builtin_exp2(i / 16.0));
      __builtin_memcpy(&entry[i], &power, 4);
      entry[i] -= i << 19;
    }
    table = _mm512_load_ps(reinterpret_cast<const float*>(entry));
  }
  // N values step by step, so that the processor finds independent instructions next to each other.
  template <int N>
  void operator()(F32x16 (&p)[N]) const {
    const __m512 magic = _mm512_set1_ps(786432.0f);  // 1.5 * 2^19
    const __m512 linear = _mm512_set1_ps(kLinear), quadratic = _mm512_set1_ps(kQuadratic), one = _mm512_set1_ps(1.0f);
    __m512 rounded[N], f[N], q[N];
    __m512i scale[N];
    for (int k = 0; k < N; ++k) rounded[k] = _mm512_add_ps(p[k].v, magic);
    for (int k = 0; k < N; ++k) scale[k] = _mm512_castps_si512(_mm512_permutexvar_ps(_mm512_castps_si512(rounded[k]), table));
    for (int k = 0; k < N; ++k) f[k] = _mm512_sub_ps(rounded[k], magic);
    for (int k = 0; k < N; ++k) f[k] = _mm512_sub_ps(p[k].v, f[k]);
    for (int k = 0; k < N; ++k) scale[k] = _mm512_add_epi32(scale[k], _mm512_slli_epi32(_mm512_castps_si512(rounded[k]), 19));
    for (int k = 0; k < N; ++k) q[k] = _mm512_fmadd_ps(f[k], quadratic, linear);
    for (int k = 0; k < N; ++k) q[k] = _mm512_fmadd_ps(q[k], f[k], one);
    for (int k = 0; k < N; ++k) p[k].v = _mm512_mul_ps(_mm512_castsi512_ps(scale[k]), q[k]);
  }
  static constexpr float kLinear = 0.69318771f, kQuadratic = 0.24022643f;  // minimax on [-1/32, 1/32]
};

// Load the first N of sixteen floats; the others are 0.
template <int N>
inline F32x16 load_first(const float* p) {
  return {_mm512_maskz_loadu_ps((1u << N) - 1, p)};
}

// Load sixteen floats; the first N are 0.
template <int N>
inline F32x16 load_from(const float* p) {
  return {_mm512_maskz_loadu_ps(0xffffu & ~((1u << N) - 1), p)};
}

// Store the first halves of a and b, then the second halves.
inline void store_halves(float* p, F32x16 a, F32x16 b) {
  _mm512_storeu_ps(p, _mm512_shuffle_f32x4(a.v, b.v, 0x44));
  _mm512_storeu_ps(p + 16, _mm512_shuffle_f32x4(a.v, b.v, 0xee));
}

// Write (first + lane) * Step for each lane of the mask to the front of the sixteen values at `to`.
template <int Step>
struct Packing {
  __m512i lane = _mm512_mullo_epi32(_mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15), _mm512_set1_epi32(Step));
  void pack(uint16_t* to, uint32_t mask, int first) const {
    const __m512i packed =
        _mm512_maskz_compress_epi32(static_cast<__mmask16>(mask), _mm512_add_epi32(lane, _mm512_set1_epi32(first * Step)));
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(to), _mm512_cvtepi32_epi16(packed));
  }
};

// Copy the places whose tiles have the bit to `to` and return their end. `to` needs room for n + 16; reads up to
// 16 beyond n.
struct Picking {
  uint32_t* operator()(uint32_t* to, const uint32_t* place, const uint16_t* tiles, uint32_t n, int bit) const {
    const __m256i wanted = _mm256_set1_epi16(static_cast<int16_t>(1 << bit));
    const auto sixteen = [&](uint32_t i, uint32_t valid) {
      const __m256i of = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(tiles + i));
      const uint32_t mask = _mm256_mask_test_epi16_mask(static_cast<__mmask16>(valid), of, wanted);
      _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(static_cast<__mmask16>(mask), _mm512_loadu_si512(place + i)));
      to += __builtin_popcount(mask);
    };
    uint32_t i = 0;
    for (; i + 16 <= n; i += 16) sixteen(i, 0xffff);
    if (i < n) sixteen(i, (1u << (n - i)) - 1);
    return to;
  }
};

// Load sixteen rows of three floats as three columns.
inline void load3(const float* p, F32x16& a, F32x16& b, F32x16& c) {
  const __m512 x = _mm512_loadu_ps(p), y = _mm512_loadu_ps(p + 16), z = _mm512_loadu_ps(p + 32);
  const auto column = [&](__m512i from_xy, __m512i from_z) {
    return _mm512_permutex2var_ps(_mm512_permutex2var_ps(x, from_xy, y), from_z, z);
  };
  a.v = column(_mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0),
               _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29));
  b.v = column(_mm512_setr_epi32(1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0),
               _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30));
  c.v = column(_mm512_setr_epi32(2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0),
               _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31));
}

// Turn two or three columns of sixteen rows into consecutive rows.
inline void interleave2(F32x16 (&r)[2]) {
  const __m512i low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
  const __m512 a = r[0].v, b = r[1].v;
  r[0].v = _mm512_permutex2var_ps(a, low, b), r[1].v = _mm512_permutex2var_ps(a, _mm512_add_epi32(low, _mm512_set1_epi32(8)), b);
}
inline void interleave3(F32x16 (&r)[3]) {
  const __m512 a = r[0].v, b = r[1].v, c = r[2].v;
  const auto line = [&](__m512i from_ab, __m512i from_c) {
    return _mm512_permutex2var_ps(_mm512_permutex2var_ps(a, from_ab, b), from_c, c);
  };
  r[0].v = line(_mm512_setr_epi32(0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5),
                _mm512_setr_epi32(0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15));
  r[1].v = line(_mm512_setr_epi32(21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26),
                _mm512_setr_epi32(0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15));
  r[2].v = line(_mm512_setr_epi32(0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0),
                _mm512_setr_epi32(26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31));
}

// a = m * 2^e with m in [0.75, 1.5)
inline void split_exponent(F32x16 a, F32x16& m, F32x16& e) {
  m.v = _mm512_getmant_ps(a.v, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_src);
  const __m512 up = _mm512_getexp_ps(a.v);  // floor(log2 a)
  const __m512 mant = _mm512_getmant_ps(a.v, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_src);
  e.v = _mm512_mask_add_ps(up, _mm512_cmp_ps_mask(mant, _mm512_set1_ps(1.5f), _CMP_GE_OQ), up, _mm512_set1_ps(1.0f));
}

inline void load_pairs(const float* const (&p)[16], F32x16& first, F32x16& second) {
  __m512d quarter[4];
  for (int i = 0; i < 4; ++i) {
    const auto two = [&](int k) {
      const __m128i low = _mm_loadl_epi64(reinterpret_cast<const __m128i_u*>(p[k]));  // aligned to four bytes only
      return _mm_loadh_pd(_mm_castsi128_pd(low), reinterpret_cast<const double*>(p[k + 1]));
    };
    quarter[i] = _mm512_castpd256_pd512(_mm256_insertf128_pd(_mm256_castpd128_pd256(two(4 * i)), two(4 * i + 2), 1));
  }
  const __m512 a = _mm512_castpd_ps(_mm512_insertf64x4(quarter[0], _mm512_castpd512_pd256(quarter[1]), 1));
  const __m512 b = _mm512_castpd_ps(_mm512_insertf64x4(quarter[2], _mm512_castpd512_pd256(quarter[3]), 1));
  const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
  first.v = _mm512_permutex2var_ps(a, even, b);
  second.v = _mm512_permutex2var_ps(a, _mm512_add_epi32(even, _mm512_set1_epi32(1)), b);
}

// A register is four quarters of four lanes. column<C>: lane C of each quarter in all its lanes.
template <int C>
inline F32x16 column(F32x16 a) {
  return {_mm512_permute_ps(a.v, C * 0x55)};
}
// Transpose each quarter of four registers as a 4 x 4 matrix.
inline void transpose4(F32x16 (&r)[4]) {
  const __m512 a = _mm512_unpacklo_ps(r[0].v, r[1].v), b = _mm512_unpackhi_ps(r[0].v, r[1].v);
  const __m512 c = _mm512_unpacklo_ps(r[2].v, r[3].v), d = _mm512_unpackhi_ps(r[2].v, r[3].v);
  r[0].v = _mm512_shuffle_ps(a, c, 0x44), r[1].v = _mm512_shuffle_ps(a, c, 0xee);
  r[2].v = _mm512_shuffle_ps(b, d, 0x44), r[3].v = _mm512_shuffle_ps(b, d, 0xee);
}
// Quarter q of register j becomes quarter j of register q.
inline void transpose_quarters(F32x16 (&r)[4]) {
  const __m512 a = _mm512_shuffle_f32x4(r[0].v, r[1].v, 0x44), b = _mm512_shuffle_f32x4(r[0].v, r[1].v, 0xee);
  const __m512 c = _mm512_shuffle_f32x4(r[2].v, r[3].v, 0x44), d = _mm512_shuffle_f32x4(r[2].v, r[3].v, 0xee);
  r[0].v = _mm512_shuffle_f32x4(a, c, 0x88), r[1].v = _mm512_shuffle_f32x4(a, c, 0xdd);
  r[2].v = _mm512_shuffle_f32x4(b, d, 0x88), r[3].v = _mm512_shuffle_f32x4(b, d, 0xdd);
}
// Quarter j of the result is the sum of the quarters of register j.
inline F32x16 sum_quarters(const F32x16 (&r)[4]) {
  const auto halves = [](__m512 a, __m512 b) {  // first half: of a, second half: of b
    return _mm512_add_ps(_mm512_mask_blend_ps(0xff00, a, b), _mm512_shuffle_f32x4(a, b, 0x4e));
  };
  const __m512 a = halves(r[0].v, r[1].v), b = halves(r[2].v, r[3].v);
  return {_mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x88), _mm512_shuffle_f32x4(a, b, 0xdd))};
}

inline void transpose(F32x16 (&r)[16]) {
  __m512 t[16];
  for (int i = 0; i < 8; ++i) {
    t[2 * i] = _mm512_unpacklo_ps(r[2 * i].v, r[2 * i + 1].v);
    t[2 * i + 1] = _mm512_unpackhi_ps(r[2 * i].v, r[2 * i + 1].v);
  }
  __m512 s[16];
  for (int i = 0; i < 4; ++i) {
    for (int h = 0; h < 2; ++h) {
      const __m512d a = _mm512_castps_pd(t[4 * i + h]), b = _mm512_castps_pd(t[4 * i + 2 + h]);
      s[4 * i + 2 * h] = _mm512_castpd_ps(_mm512_unpacklo_pd(a, b));
      s[4 * i + 2 * h + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(a, b));
    }
  }
  for (int k = 0; k < 4; ++k) {
    const __m512 a = _mm512_shuffle_f32x4(s[k], s[4 + k], 0x88), b = _mm512_shuffle_f32x4(s[k], s[4 + k], 0xdd);
    const __m512 c = _mm512_shuffle_f32x4(s[8 + k], s[12 + k], 0x88), d = _mm512_shuffle_f32x4(s[8 + k], s[12 + k], 0xdd);
    r[k].v = _mm512_shuffle_f32x4(a, c, 0x88);
    r[8 + k].v = _mm512_shuffle_f32x4(a, c, 0xdd);
    r[4 + k].v = _mm512_shuffle_f32x4(b, d, 0x88);
    r[12 + k].v = _mm512_shuffle_f32x4(b, d, 0xdd);
  }
}

}  // namespace se
