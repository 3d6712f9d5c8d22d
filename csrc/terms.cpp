// Two sums of the objective and their gradients, one pass each: volumes of Gaussians and the opacity hinge. The
// gradients are rounded like autograd's.
#include <algorithm>
#include <cstdint>

#include "pool.h"
#include "se_api.h"

namespace {
constexpr int64_t kGrain = 8192;

inline double sum_lanes(const double* lanes) {
  return ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) + ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7]));
}
}  // namespace

SE_EXPORT int64_t se_sum_chunks(int64_t count) { return (count + kGrain - 1) / kGrain; }

SE_EXPORT void se_volume_forward(const float* scales, int64_t count, double* partial, int32_t threads) {
  se::parallel_for(count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
    double lanes[8] = {};
    for (int64_t i = begin; i < end; ++i) lanes[i % 8] += scales[3 * i] * scales[3 * i + 1] * scales[3 * i + 2];
    partial[begin / kGrain] = sum_lanes(lanes);
  });
}

SE_EXPORT void se_volume_backward(const float* scales, int64_t count, float upstream, float* gradient, int32_t threads) {
  se::parallel_for(count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; ++i) {
      const float x = scales[3 * i], y = scales[3 * i + 1], z = scales[3 * i + 2], by_z = upstream * z;
      gradient[3 * i] = by_z * y;
      gradient[3 * i + 1] = by_z * x;
      gradient[3 * i + 2] = upstream * (x * y);
    }
  });
}

SE_EXPORT void se_hinge_forward(const float* raw, int64_t count, float tau, double* partial, int32_t threads) {
  se::parallel_for(count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
    double lanes[8] = {};
    int64_t i = begin;
    for (; i + 8 <= end; i += 8)
      for (int j = 0; j < 8; ++j) lanes[j] += std::max(tau - raw[i + j], 0.f);
    for (; i < end; ++i) lanes[0] += std::max(tau - raw[i], 0.f);
    partial[begin / kGrain] = sum_lanes(lanes);
  });
}

SE_EXPORT void se_hinge_backward(const float* raw, int64_t count, float tau, float upstream, float* gradient, int32_t threads) {
  se::parallel_for(count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; ++i) gradient[i] = tau - raw[i] > 0.f ? -upstream : -0.f;
  });
}
