// Arithmetic peak of this processor: a loop of independent multiply-adds, run by the thread pool of all native
// work.
#include <algorithm>
#include <atomic>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"

namespace se {
namespace {

constexpr int64_t kRounds = 4096;  // per chunk: some tens of microseconds
constexpr int kChains = 12;        // independent sums: more than latency times units, fewer than registers

// The compiler cannot simplify this loop: it may not reassociate floats, and every chain has its own start.
float run_chunk(float start) {
  const Vec a = broadcast(0.999f), b = broadcast(0.001f);
  Vec s0 = broadcast(start), s1 = broadcast(start + 1), s2 = broadcast(start + 2), s3 = broadcast(start + 3), s4 = broadcast(start + 4),
      s5 = broadcast(start + 5);
  Vec s6 = broadcast(start + 6), s7 = broadcast(start + 7), s8 = broadcast(start + 8), s9 = broadcast(start + 9),
      s10 = broadcast(start + 10), s11 = broadcast(start + 11);
  for (int64_t i = 0; i < kRounds; ++i) {
    s0 = fma(s0, a, b), s1 = fma(s1, a, b), s2 = fma(s2, a, b), s3 = fma(s3, a, b), s4 = fma(s4, a, b), s5 = fma(s5, a, b);
    s6 = fma(s6, a, b), s7 = fma(s7, a, b), s8 = fma(s8, a, b), s9 = fma(s9, a, b), s10 = fma(s10, a, b), s11 = fma(s11, a, b);
  }
  return sum(s0 + s1 + s2 + s3 + s4 + s5 + s6 + s7 + s8 + s9 + s10 + s11);
}

}  // namespace
}  // namespace se

SE_EXPORT double se_benchmark_multiply_adds(int64_t chunks, int32_t threads) {
  std::atomic<int> strange{0};
  se::parallel_for(chunks, 1, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t c = begin; c < end; ++c)
      if (!(se::run_chunk(static_cast<float>(c)) > 0)) strange.fetch_add(1);  // never true; keeps the compiler from removing the loop
  });
  return static_cast<double>(chunks - strange.load()) * se::kRounds * se::kChains * se::LANES;
}
