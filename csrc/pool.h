// A pool in which the caller works too: chunks are claimed from a shared counter, so a worker that the system has put
// aside delays nothing but its own chunk (OpenMP barriers fell to 0.67x of one thread on a busy machine).
#pragma once
#include <cstdint>
#include <type_traits>

namespace se {

// Runs body(context, begin, end, worker) over [0, n) in chunks of `grain`, on at most `threads` workers, the caller being worker 0.
// Which worker takes which chunk is not fixed; chunk boundaries are (multiples of grain), so results that depend on the chunk
// alone are the same for every number of threads. What a body throws is thrown to the caller, once, after all have left.
void parallel_chunks(int64_t n, int64_t grain, int threads, void (*body)(void*, int64_t, int64_t, int), void* context);

template <class F>
void parallel_for(int64_t n, int64_t grain, int threads, F&& f) {
  using Fn = std::remove_reference_t<F>;
  parallel_chunks(
      n, grain, threads, [](void* c, int64_t begin, int64_t end, int worker) { (*static_cast<Fn*>(c))(begin, end, worker); },
      const_cast<std::remove_const_t<Fn>*>(&f));
}

}  // namespace se
