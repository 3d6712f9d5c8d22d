// Add the density statistics of one view to the table in one pass. Sums are in torch's order, so both give the
// same bits.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "pool.h"
#include "se_api.h"

namespace {
constexpr int64_t kRows = 1024, kDrawn = 8192;  // per chunk

// Sum of max(0, x[k]) over K < 512 values in torch's order: eight lanes in four strands, then the sum of the
// strands, then the tail and the lanes one by one.
float sum_positive(const float* x, int64_t K) {
  if (K < 8) {
    float part[4] = {};
    const int64_t whole = K / 4 * 4;
    for (int64_t k = 0; k < K; ++k) part[k < whole ? k % 4 : 0] += std::max(x[k], 0.f);
    return ((part[0] + part[1]) + part[2]) + part[3];
  }
  float lanes[4][8] = {};
  const int64_t vectors = K / 8, whole = vectors / 4 * 4;
  for (int64_t v = 0; v < vectors; ++v)
    for (int j = 0; j < 8; ++j) lanes[v < whole ? v % 4 : 0][j] += std::max(x[8 * v + j], 0.f);
  float sum = 0.f;
  for (int64_t k = 8 * vectors; k < K; ++k) sum += std::max(x[k], 0.f);
  for (int j = 0; j < 8; ++j) sum += ((lanes[0][j] + lanes[1][j]) + lanes[2][j]) + lanes[3][j];
  return sum;
}
}  // namespace

// Each row occurs at most once.
SE_EXPORT void se_observe_rows(const int64_t* rows, const float* raw, int64_t count, int64_t K, float* visits, float* opacity,
                               int32_t threads) {
  se::parallel_for(count, kRows, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t a = begin; a < end; ++a) {
      const float sum = sum_positive(raw + a * K, K);
      visits[rows[a]] += 1.f;
      opacity[rows[a]] += sum;
    }
  });
}

// Each slot occurs at most once in `source`.
SE_EXPORT void se_observe_drawn(const int32_t* radii, const float* gradient, const int64_t* source, int64_t count, float* grad,
                                float* counted, int32_t threads) {
  se::parallel_for(count, kDrawn, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; ++i) {
      if (radii[i] <= 0) continue;
      const float x = gradient[2 * i], y = gradient[2 * i + 1];
      grad[source[i]] += std::sqrt(std::fma(y, y, x * x));
      counted[source[i]] += 1.f;
    }
  });
}
