// Adam (Kingma and Ba 2015) over many tensors in one call and one pass over memory. The result equals PyTorch's
// fused Adam (AVX2, AVX-512) bit for bit, so a training can continue with either.
//
//   m += (1 - beta1) (g - m),  v = beta2 v + (1 - beta2) g g,  p -= step_size m / (sqrt(v) / root + eps)
//
// step_size is the learning rate / (1 - beta1^t) and root is sqrt(1 - beta2^t). With `rows`, only these rows are
// updated; the others keep their values and moments.
//
// The same pass finds numbers that are not finite: 0 x is 0 for a finite x, else NaN. A value and its second moment
// are enough, because a first moment that is not finite makes one of the two so.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"

namespace se {
namespace {

constexpr int64_t kGrain = 32768;  // elements per chunk: 900 kB of memory traffic, long compared to claiming a chunk
constexpr int64_t kAhead = 8;      // prefetch distance in rows

struct Constants {
  float rate1, beta2, rate2, eps, step_size, root;  // rates: 1 - beta
};

// found: sums of 0 x over the new values and second moments x; NaN if one of them is not finite.
void update_span(const Constants& c, const SeAdamTensor& t, int64_t begin, int64_t end, Vec& found) {
  const Vec rate1 = broadcast(c.rate1), beta2 = broadcast(c.beta2), rate2 = broadcast(c.rate2), eps = broadcast(c.eps),
            step = broadcast(-c.step_size), root = broadcast(c.root), none = broadcast(0.0f);
  int64_t i = begin;
  for (; i + LANES <= end; i += LANES) {
    const Vec g = load(t.gradient + i), old = load(t.first + i);
    const Vec first = fma(rate1, g - old, old);
    const Vec second = fma(rate2 * g, g, load(t.second + i) * beta2);
    store(t.first + i, first);
    store(t.second + i, second);
    const Vec value = load(t.value + i) + step * first / (square_root(second) / root + eps);
    store(t.value + i, value);
    found = found + (value * none + second * none);
  }
  if (t.rows && i < end) {  // the tail of a row may end at the end of memory: one partial register
    const int n = static_cast<int>(end - i);
    const Vec g = load_part(t.gradient + i, n), old = load_part(t.first + i, n);
    const Vec first = fma(rate1, g - old, old);
    const Vec second = fma(rate2 * g, g, load_part(t.second + i, n) * beta2);
    store_part(t.first + i, first, n);
    store_part(t.second + i, second, n);
    store_part(t.value + i, load_part(t.value + i, n) + step * first / (square_root(second) / root + eps), n);
    found = found + (load_part(t.value + i, n) * none + second * none);  // loaded again: beyond the tail 0 / eps may be NaN
    return;
  }
  // PyTorch's kernel computes eight elements at a time. In its scalar tail the compiler fuses the other product.
  const int64_t eights = begin + (end - begin) / 8 * 8;
  for (; i < end; ++i) {
    const float g = t.gradient[i], scaled = c.rate2 * g;
    t.first[i] = std::fma(c.rate1, g - t.first[i], t.first[i]);
    t.second[i] = i < eights ? std::fma(scaled, g, t.second[i] * c.beta2) : std::fma(t.second[i], c.beta2, scaled * g);
    t.value[i] -= c.step_size * t.first[i] / (std::sqrt(t.second[i]) / c.root + c.eps);
    found = found + broadcast(t.value[i] * 0.0f + t.second[i] * 0.0f);
  }
}

inline void prefetch_row(const SeAdamTensor& t, int64_t row) {
  for (int64_t i = row * t.width; i < (row + 1) * t.width; i += 16) {
    __builtin_prefetch(t.gradient + i, 0);
    __builtin_prefetch(t.first + i, 1);
    __builtin_prefetch(t.second + i, 1);
    __builtin_prefetch(t.value + i, 1);
  }
}

// Adjacent rows form one span, so that short rows have no tail each.
void update_rows(const Constants& c, const SeAdamTensor& t, int64_t begin, int64_t end, Vec& found) {
  while (begin < end) {
    int64_t last = begin + 1;
    while (last < end && t.rows[last] == t.rows[last - 1] + 1) ++last;
    for (int64_t ahead = begin + kAhead; ahead < std::min(end, last + kAhead); ++ahead) prefetch_row(t, t.rows[ahead]);
    update_span(c, t, t.rows[begin] * t.width, (t.rows[last - 1] + 1) * t.width, found);
    begin = last;
  }
}

int64_t chunk_size(const SeAdamTensor& t) { return std::max<int64_t>(1, kGrain / std::max<int64_t>(1, t.width)); }

int64_t count_chunks(const SeAdamTensor& t) { return (t.count + chunk_size(t) - 1) / chunk_size(t); }

}  // namespace
}  // namespace se

SE_EXPORT int64_t se_adam_step(const SeAdamTensor* tensors, int64_t count, double beta1, double beta2, double eps, int32_t threads) {
  int64_t total = 0;
  for (int64_t i = 0; i < count; ++i) total += se::count_chunks(tensors[i]);
  const auto single = [](double x) { return static_cast<float>(x); };
  std::atomic<int64_t> bad{count};
  se::parallel_for(total, 1, threads, [&](int64_t chunk, int64_t, int) {
    const SeAdamTensor* t = tensors;
    for (; chunk >= se::count_chunks(*t); ++t) chunk -= se::count_chunks(*t);
    const se::Constants c{single(1 - beta1), single(beta2), single(1 - beta2), single(eps), single(t->step_size), single(t->root)};
    const int64_t from = chunk * se::chunk_size(*t), to = std::min(t->count, from + se::chunk_size(*t));
    se::Vec found = se::broadcast(0.0f);
    if (t->rows)
      se::update_rows(c, *t, from, to, found);
    else
      se::update_span(c, *t, from, to, found);
    if (se::sum(found) != 0.0f) {
      const int64_t number = t - tensors;
      for (int64_t least = bad; number < least && !bad.compare_exchange_weak(least, number);) {
      }
    }
  });
  return bad < count ? bad.load() : -1;
}
