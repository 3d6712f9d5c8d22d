// Integer contexts of compact files: what is predicted of a value from values that are decoded already. Sums stay below 2^31 for at
// most kMostInputs inputs. The slow form is src/scene_experts/files/codec/reference.py.
#include <algorithm>
#include <cstdint>

#include "code.h"
#include "se_api.h"

namespace {
constexpr int64_t kRows = 1024;      // of a block, whose sums stay in the cache
constexpr int32_t kReach = 2047;     // largest input
constexpr int32_t kLargest = 1 << 26;  // largest mean, in 1/32 of a channel's step

inline int32_t shifted(int32_t sum, int32_t shift) {
  if (shift > 0) return (sum + (1 << shift >> 1)) >> shift;
  return std::clamp(sum, -(kLargest >> -shift), kLargest >> -shift) * (1 << -shift);
}
}  // namespace

SE_EXPORT void se_code_predict(const int16_t* inputs, int64_t stride, const int8_t* weights, const int32_t* numbers, int64_t D,
                               const int8_t* classes, int64_t count, int32_t* mean, int32_t* scale) {
  for (int64_t begin = 0; begin < count; begin += kRows) {
    const int64_t n = std::min(kRows, count - begin);
    int32_t sums[2][kRows];
    std::fill(sums[0], sums[0] + n, numbers[0]);
    std::fill(sums[1], sums[1] + n, numbers[2]);
    for (int64_t d = 0; d < D; ++d) {
      const int32_t w = weights[d], v = weights[D + d];
      const int16_t* x = inputs + d * stride + begin;
      if (w && v)
        for (int64_t i = 0; i < n; ++i) sums[0][i] += w * x[i], sums[1][i] += v * x[i];
      else if (w)
        for (int64_t i = 0; i < n; ++i) sums[0][i] += w * x[i];
      else if (v)
        for (int64_t i = 0; i < n; ++i) sums[1][i] += v * x[i];
    }
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
  for (int64_t c = 0; c < C; ++c)
    for (int64_t i = 0; i < count; ++i) {
      int32_t sum = 0;
      for (int j = 0; j < 4; ++j) sum += weights[4 * i + j] * columns[c * N + parents[4 * i + j]];
      out[c * count + i] = static_cast<int16_t>(sum >> 8);
    }
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
