// The clock rate of the core: each addition of a dependent chain takes one cycle.
#include <time.h>

#include <algorithm>
#include <cstdint>

extern "C" double peer_clock_hz() {
  const auto now = [] {
    timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
  };
  double best = 1e9;
  for (int turn = 0; turn < 4; ++turn) {
    const double start = now();
    uint64_t x = 1;
    for (int i = 0; i < 500000; ++i) {
      for (int k = 0; k < 8; ++k) {
        x += 3;
        asm volatile("" : "+r"(x));  // keeps the compiler from folding the additions
      }
    }
    best = std::min(best, now() - start);
  }
  return 4e6 / best;
}
