#include "pool.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace se {
namespace {

struct Job {
  void (*body)(void*, int64_t, int64_t, int) = nullptr;
  void* context = nullptr;
  int64_t n = 0, grain = 1, chunks = 0;
  int slots = 0;  // workers that may still join
  std::atomic<int64_t> next{0};
  std::atomic<bool> failed{false};
  std::exception_ptr error;  // the first exception thrown; the caller rethrows it after all workers have left

  void run_chunks(int worker) noexcept {
    try {
      for (;;) {
        const int64_t chunk = next.fetch_add(1, std::memory_order_relaxed);
        if (chunk >= chunks) return;
        body(context, chunk * grain, std::min(n, (chunk + 1) * grain), worker);
      }
    } catch (...) {
      if (!failed.exchange(true)) error = std::current_exception();
      next.store(chunks, std::memory_order_relaxed);
    }
  }
};

inline void pause() {
#if defined(__x86_64__) || defined(__i386__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

// Spin until the condition holds or a millisecond has passed; return whether it holds. Sleeping would be slower:
// waking up takes microseconds, and hundreds of them on an idle core of a virtual machine. For 25 us the thread
// keeps its core; then it yields to other threads, for about as long as the gaps between the jobs of one frame.
template <class Condition>
bool spin_until(Condition&& condition) {
  const auto begin = std::chrono::steady_clock::now();
  for (;;) {
    for (int i = 0; i < 16; ++i) {
      if (condition()) return true;
      pause();
    }
    const auto waited = std::chrono::steady_clock::now() - begin;
    if (waited > std::chrono::microseconds(1000)) return false;
    if (waited > std::chrono::microseconds(25)) std::this_thread::yield();
  }
}

class Pool {
 public:
  void run(Job& job, int threads) {
    bool wake;
    {
      std::lock_guard lock(mutex_);
      try {
        while (static_cast<int>(workers_.size()) < threads - 1) workers_.emplace_back([this] { run_worker(); });
      } catch (const std::exception&) {  // no memory for another worker: the existing ones do the work
      }
      job_ = &job;
      joined_ = 0;
      job.slots = threads - 1;
      generation_.fetch_add(1, std::memory_order_release);
      wake = asleep_ > 0;
    }
    if (wake) wake_.notify_all();
    job.run_chunks(0);
    {
      std::lock_guard lock(mutex_);
      job_ = nullptr;  // no worker joins from here on
    }
    spin_until([&] { return active_.load(std::memory_order_acquire) == 0; });
    std::unique_lock lock(mutex_);
    idle_.wait(lock, [&] { return active_ == 0; });
  }

  ~Pool() {
    {
      std::lock_guard lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    for (auto& worker : workers_) worker.join();
  }

 private:
  void run_worker() {
    uint64_t seen = 0;
    std::unique_lock lock(mutex_);
    for (;;) {
      const auto called = [&] { return stop_ || (job_ && generation_ != seen); };
      if (!called()) {
        lock.unlock();
        spin_until([&] { return generation_.load(std::memory_order_acquire) != seen; });
        lock.lock();
        ++asleep_;
        wake_.wait(lock, called);
        --asleep_;
      }
      if (stop_) return;
      seen = generation_;
      Job* job = job_;
      if (joined_ >= job->slots) continue;
      const int worker = ++joined_;
      ++active_;
      lock.unlock();
      job->run_chunks(worker);
      lock.lock();
      if (--active_ == 0) idle_.notify_all();
    }
  }

  std::mutex mutex_;
  std::condition_variable wake_, idle_;
  std::vector<std::thread> workers_;
  Job* job_ = nullptr;
  std::atomic<uint64_t> generation_ = 0;  // changed under the mutex like all members; read without it while spinning
  std::atomic<int> active_ = 0;
  int joined_ = 0, asleep_ = 0;
  bool stop_ = false;
};

std::mutex run_mutex;  // one job at a time; a second caller works alone

Pool& pool() {
  static Pool* instance = new Pool;  // never destroyed: workers may outlive static destructors at interpreter exit
  return *instance;
}

}  // namespace

void parallel_chunks(int64_t n, int64_t grain, int threads, void (*body)(void*, int64_t, int64_t, int), void* context) {
  if (n <= 0) return;
  Job job;
  job.body = body;
  job.context = context;
  job.n = n;
  job.grain = std::max<int64_t>(1, grain);
  job.chunks = (n + job.grain - 1) / job.grain;
  threads = static_cast<int>(std::min<int64_t>(threads, job.chunks));
  std::unique_lock lock(run_mutex, std::defer_lock);
  if (threads <= 1 || !lock.try_lock()) {
    job.run_chunks(0);
  } else {
    pool().run(job, threads);
  }
  if (job.error) std::rethrow_exception(job.error);
}

}  // namespace se
