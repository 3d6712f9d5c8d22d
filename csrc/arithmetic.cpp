// What this processor can do at most: a loop of multiply-adds that waits for nothing, through the pool that all native work goes through.
#include <algorithm>
#include <atomic>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"

namespace se {
namespace {

constexpr int64_t kRounds = 4096;  // of a chunk: some tens of microseconds
constexpr int kChains = 12;        // independent sums: more than latency times units, fewer than registers

// The compiler may not shorten this: floats are not reassociated here, and every chain starts elsewhere.
float chunk_of_sums(float start) {
  const V a = all(0.999f), b = all(0.001f);
  V s0 = all(start), s1 = all(start + 1), s2 = all(start + 2), s3 = all(start + 3), s4 = all(start + 4), s5 = all(start + 5);
  V s6 = all(start + 6), s7 = all(start + 7), s8 = all(start + 8), s9 = all(start + 9), s10 = all(start + 10), s11 = all(start + 11);
  for (int64_t i = 0; i < kRounds; ++i) {
    s0 = fma(s0, a, b), s1 = fma(s1, a, b), s2 = fma(s2, a, b), s3 = fma(s3, a, b), s4 = fma(s4, a, b), s5 = fma(s5, a, b);
    s6 = fma(s6, a, b), s7 = fma(s7, a, b), s8 = fma(s8, a, b), s9 = fma(s9, a, b), s10 = fma(s10, a, b), s11 = fma(s11, a, b);
  }
  return sum(s0 + s1 + s2 + s3 + s4 + s5 + s6 + s7 + s8 + s9 + s10 + s11);
}

}  // namespace
}  // namespace se

// Runs `chunks` chunks of multiply-adds on at most `threads` workers. Returns how many multiply-adds of single floats that were.
SE_EXPORT double se_benchmark_multiply_adds(int64_t chunks, int32_t threads) {
  std::atomic<int> strange{0};
  se::parallel_for(chunks, 1, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t c = begin; c < end; ++c)
      if (!(se::chunk_of_sums(static_cast<float>(c)) > 0)) strange.fetch_add(1);  // never; keeps the sums from being left out
  });
  return static_cast<double>(chunks - strange.load()) * se::kRounds * se::kChains * se::LANES;
}
