// A thread pool in which the caller works too. Workers claim chunks from a shared counter, so a worker that the
// system preempts delays only its own chunk. (OpenMP barriers took the speed to 0.67x of one thread on a busy
// machine.)
#pragma once
#include <cstdint>
#include <type_traits>

namespace se {

// Run body(context, begin, end, worker) over [0, n) in chunks of `grain` on at most `threads` workers; the
// caller is worker 0. The assignment of chunks to workers varies, but chunks begin at multiples of grain, so
// results that depend only on the chunk are the same for every number of threads. An exception in a body is
// rethrown to the caller once, after all workers have left.
void parallel_chunks(int64_t n, int64_t grain, int threads, void (*body)(void*, int64_t, int64_t, int), void* context);

template <class F>
void parallel_for(int64_t n, int64_t grain, int threads, F&& f) {
  using Fn = std::remove_reference_t<F>;
  parallel_chunks(
      n, grain, threads, [](void* c, int64_t begin, int64_t end, int worker) { (*static_cast<Fn*>(c))(begin, end, worker); },
      const_cast<std::remove_const_t<Fn>*>(&f));
}

}  // namespace se
