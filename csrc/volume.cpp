// Sum of the volumes of Gaussians and its gradient, each one pass over the scales; the gradient is rounded as autograd's of x y z is.
#include <algorithm>
#include <cstdint>

#include "export.h"
#include "pool.h"

namespace {
constexpr int64_t kGrain = 8192;
}

// scales [M, 3]; partial [ceil(M / 8192)], summed in order by the caller: the same for every number of threads.
SE_EXPORT int64_t se_volume_chunks(int64_t count) { return (count + kGrain - 1) / kGrain; }

SE_EXPORT void se_volume(const float* scales, int64_t count, double* partial, int32_t threads) {
  se::parallel_for(count, kGrain, threads, [&](int64_t begin, int64_t end, int) {
    double lanes[8] = {};
    for (int64_t i = begin; i < end; ++i) lanes[i % 8] += scales[3 * i] * scales[3 * i + 1] * scales[3 * i + 2];
    partial[begin / kGrain] = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) + ((lanes[4] + lanes[5]) + (lanes[6] + lanes[7]));
  });
}

// gradient [M, 3] = upstream times that of the sum.
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
