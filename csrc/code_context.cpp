// Integer contexts of compact files: what is predicted of a value from values that are decoded already. Sums stay below 2^31 for at
// most kMostInputs inputs. The slow form is src/scene_experts/files/codec/reference.py.
#include <algorithm>
#include <cstdint>
#include <vector>
#if defined(__AVX2__)
#include <immintrin.h>
#elif defined(__wasm_simd128__)
#include <wasm_simd128.h>
#endif

#include "code.h"
#include "se_api.h"

namespace {
constexpr int64_t kRows = 1024;      // of a block, whose sums stay in the cache
constexpr int64_t kTogether = 4;     // inputs that are added while the sums of some rows are at hand
constexpr int32_t kReach = 2047;     // largest input
constexpr int32_t kLargest = 1 << 26;  // largest mean, in 1/32 of a channel's step

inline int32_t shifted(int32_t sum, int32_t shift) {
  if (shift > 0) return (sum + (1 << shift >> 1)) >> shift;
  return std::clamp(sum, -(kLargest >> -shift), kLargest >> -shift) * (1 << -shift);
}

// An input and its weights in the two sums, of which one is not 0.
struct Term {
  const int16_t* inputs;
  int16_t mean, spread;
};

// The terms of a channel, filled up to a multiple of kTogether by terms of weight 0.
std::vector<Term> find_terms(const int16_t** inputs, const int8_t* weights, int64_t D) {
  std::vector<Term> terms;
  terms.reserve(static_cast<size_t>(D + kTogether));
  for (int64_t d = 0; d < D; ++d)
    if (weights[d] || weights[D + d]) terms.push_back({inputs[d], weights[d], weights[D + d]});
  while (terms.size() % kTogether) terms.push_back({inputs[0], 0, 0});
  return terms;
}

// Add terms to the sums of `count` rows from `begin` on.
void add_rows(const std::vector<Term>& terms, int64_t begin, int64_t count, int32_t* mean, int32_t* spread) {
  for (const Term& t : terms) {
    const int32_t w = t.mean, v = t.spread;
    const int16_t* x = t.inputs + begin;
    for (int64_t i = 0; i < count; ++i) mean[i] += w * x[i], spread[i] += v * x[i];
  }
}

#if defined(__AVX2__)
constexpr int64_t kWide = 16;  // rows at once
using Wide = __m256i;
inline Wide read_wide(const int16_t* at) { return _mm256_loadu_si256(reinterpret_cast<const Wide*>(at)); }
inline Wide low_pairs(Wide a, Wide b) { return _mm256_unpacklo_epi16(a, b); }
inline Wide high_pairs(Wide a, Wide b) { return _mm256_unpackhi_epi16(a, b); }
inline Wide same_pairs(uint32_t pair) { return _mm256_set1_epi32(static_cast<int32_t>(pair)); }
inline void add_products(int32_t* sums, Wide a, Wide x, Wide b, Wide y) {
  auto* at = reinterpret_cast<Wide*>(sums);
  const Wide added = _mm256_add_epi32(_mm256_madd_epi16(a, x), _mm256_madd_epi16(b, y));
  _mm256_storeu_si256(at, _mm256_add_epi32(_mm256_loadu_si256(at), added));
}
// Pairs leave the sums of 16 rows in the order 0 - 3, 8 - 11, 4 - 7, 12 - 15.
inline void sort_rows(int32_t* sums) {
  auto* at = reinterpret_cast<Wide*>(sums);
  const Wide low = _mm256_loadu_si256(at), high = _mm256_loadu_si256(at + 1);
  _mm256_storeu_si256(at, _mm256_permute2x128_si256(low, high, 0x20));
  _mm256_storeu_si256(at + 1, _mm256_permute2x128_si256(low, high, 0x31));
}
#elif defined(__wasm_simd128__)
constexpr int64_t kWide = 8;
using Wide = v128_t;
inline Wide read_wide(const int16_t* at) { return wasm_v128_load(at); }
inline Wide low_pairs(Wide a, Wide b) { return wasm_i16x8_shuffle(a, b, 0, 8, 1, 9, 2, 10, 3, 11); }
inline Wide high_pairs(Wide a, Wide b) { return wasm_i16x8_shuffle(a, b, 4, 12, 5, 13, 6, 14, 7, 15); }
inline Wide same_pairs(uint32_t pair) { return wasm_u32x4_splat(pair); }
inline void add_products(int32_t* sums, Wide a, Wide x, Wide b, Wide y) {
  const Wide added = wasm_i32x4_add(wasm_i32x4_dot_i16x8(a, x), wasm_i32x4_dot_i16x8(b, y));
  wasm_v128_store(sums, wasm_i32x4_add(wasm_v128_load(sums), added));
}
inline void sort_rows(int32_t*) {}
#endif

#if defined(__AVX2__) || defined(__wasm_simd128__)
#define SE_WIDE 1
// The two weights of a pair of inputs in each lane.
inline Wide pair_of(int16_t first, int16_t second) {
  return same_pairs(static_cast<uint16_t>(first) | static_cast<uint32_t>(static_cast<uint16_t>(second)) << 16);
}

// Add terms to the sums of `count` rows, a multiple of kWide. Two inputs are multiplied and added by one instruction.
void add_wide(const std::vector<Term>& terms, int64_t begin, int64_t count, int32_t* mean, int32_t* spread) {
  for (size_t k = 0; k < terms.size(); k += kTogether) {
    const Term* t = &terms[k];
    const Wide mean0 = pair_of(t[0].mean, t[1].mean), mean1 = pair_of(t[2].mean, t[3].mean);
    const Wide spread0 = pair_of(t[0].spread, t[1].spread), spread1 = pair_of(t[2].spread, t[3].spread);
    const auto read = [&](int j, int64_t i) { return read_wide(t[j].inputs + begin + i); };
    for (int64_t i = 0; i < count; i += kWide) {
      const Wide a = read(0, i), b = read(1, i), c = read(2, i), d = read(3, i);
      const Wide low0 = low_pairs(a, b), high0 = high_pairs(a, b), low1 = low_pairs(c, d), high1 = high_pairs(c, d);
      add_products(mean + i, low0, mean0, low1, mean1);
      add_products(mean + i + kWide / 2, high0, mean0, high1, mean1);
      add_products(spread + i, low0, spread0, low1, spread1);
      add_products(spread + i + kWide / 2, high0, spread0, high1, spread1);
    }
  }
  for (int64_t i = 0; i < count; i += kWide) sort_rows(mean + i), sort_rows(spread + i);
}
#endif

// `kColumns` columns at once, so that parents and weights are read once for all of them.
template <int64_t kColumns>
void blend_columns(const int16_t* columns, int64_t N, const int32_t* parents, const int32_t* weights, int64_t count, int16_t* out) {
  for (int64_t i = 0; i < count; ++i) {
    const int32_t *p = parents + 4 * i, *w = weights + 4 * i;
    for (int64_t c = 0; c < kColumns; ++c) {
      const int16_t* x = columns + c * N;
      out[c * count + i] = static_cast<int16_t>((w[0] * x[p[0]] + w[1] * x[p[1]] + w[2] * x[p[2]] + w[3] * x[p[3]]) >> 8);
    }
  }
}
}  // namespace

SE_EXPORT void se_code_predict(const int16_t** inputs, const int8_t* weights, const int32_t* numbers, int64_t D, const int8_t* classes,
                               int64_t count, int32_t* mean, int32_t* scale) {
  const std::vector<Term> terms = find_terms(inputs, weights, D);
  for (int64_t begin = 0; begin < count; begin += kRows) {
    const int64_t n = std::min(kRows, count - begin);
    int32_t sums[2][kRows];
    std::fill(sums[0], sums[0] + n, numbers[0]);
    std::fill(sums[1], sums[1] + n, numbers[2]);
    int64_t done = 0;
#if SE_WIDE
    done = n / kWide * kWide;
    add_wide(terms, begin, done, sums[0], sums[1]);
#endif
    add_rows(terms, begin + done, n - done, sums[0] + done, sums[1] + done);
    for (int64_t i = 0; i < n; ++i) {
      const int32_t fine = classes[begin + i] + 2;
      const int32_t m = std::clamp(shifted(sums[0][i], numbers[1]), -kLargest, kLargest);
      mean[begin + i] = (m + (1 << fine >> 1)) >> fine;
      scale[begin + i] = std::clamp(shifted(sums[1][i], numbers[3]) + 32 - 8 * (fine - 2), 0, se::kCodeTopScale);
    }
  }
}

SE_EXPORT void se_code_inputs(const int32_t* values, const int8_t* classes, int64_t count, int32_t factor, int32_t offset, int16_t* out) {
  const int32_t most = (1 << 29) / factor;
  for (int64_t i = 0; i < count; ++i) {
    const int32_t fine = classes[i] + 2, reach = most >> fine;
    const int32_t value = std::clamp(values[i], -reach, reach) * (1 << fine);
    out[i] = static_cast<int16_t>(std::clamp((value * factor - offset + 2048) >> 12, -kReach, kReach));
  }
}

SE_EXPORT void se_code_blend(const int16_t* columns, int64_t N, int64_t C, const int32_t* parents, const int32_t* weights, int64_t count,
                             int16_t* out) {
  int64_t c = 0;
  for (; c + kTogether <= C; c += kTogether) blend_columns<kTogether>(columns + c * N, N, parents, weights, count, out + c * count);
  for (; c < C; ++c) blend_columns<1>(columns + c * N, N, parents, weights, count, out + c * count);
}

SE_EXPORT void se_code_parents(const int32_t* cells, const int32_t* rows, int64_t count, const int32_t* coarse, int64_t coarse_count,
                               int32_t* parents, int32_t* weights) {
  int64_t at = 0;
  for (int64_t i = 0; i < count; ++i) {
    const int32_t* own = cells + 3 * static_cast<int64_t>(rows[i]);
    while (at < coarse_count && coarse[at] < rows[i]) ++at;
    int32_t found[4], share[4], total = 0;
    for (int j = 0; j < 4; ++j) {
      const int64_t place = at - 2 + j;
      const bool there = place >= 0 && place < coarse_count;
      found[j] = there ? coarse[place] : 0;
      share[j] = 0;
      if (!there) continue;
      const int32_t* other = cells + 3 * static_cast<int64_t>(found[j]);
      int32_t away = 1;
      for (int a = 0; a < 3; ++a) away += own[a] > other[a] ? own[a] - other[a] : other[a] - own[a];
      share[j] = 65536 / away;
      total += share[j];
    }
    for (int j = 0; j < 4; ++j) {
      parents[4 * i + j] = found[j];
      weights[4 * i + j] = total ? share[j] * 256 / total : 0;
    }
  }
}
