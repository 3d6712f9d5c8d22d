// Adam (Kingma and Ba 2015) over many tensors in one call and one pass over memory, bit for bit as PyTorch's fused Adam with AVX2 or
// AVX-512 computes it, so that a training may go on with either.
//
//   m += (1 - beta1) (g - m),  v = beta2 v + (1 - beta2) g g,  p -= step_size m / (sqrt(v) / root + eps)
//
// step_size is the learning rate over 1 - beta1^t, root is sqrt(1 - beta2^t). With `rows`, only those rows move; the others keep their
// value and moments.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"

namespace se {
namespace {

constexpr int64_t kGrain = 32768;  // elements a worker takes at a time: 900 kB of traffic, long beside the claim of a chunk
constexpr int64_t kAhead = 8;      // rows that are on their way from memory while one is worked on

struct Constants {
  float rate1, beta2, rate2, eps, step_size, root;  // rates: 1 - beta
};

// The first n < LANES floats at p, the others zero; and the way back.
inline Vec load_part(const float* p, int64_t n) {
#if defined(__AVX512F__)
  return {_mm512_maskz_loadu_ps(static_cast<__mmask16>((1u << n) - 1), p)};
#else
  float x[LANES] = {};
  for (int64_t j = 0; j < n; ++j) x[j] = p[j];
  return load(x);
#endif
}

inline void store_some(float* p, Vec a, int64_t n) {
#if defined(__AVX512F__)
  _mm512_mask_storeu_ps(p, static_cast<__mmask16>((1u << n) - 1), a.v);
#else
  float x[LANES];
  store(x, a);
  for (int64_t j = 0; j < n; ++j) p[j] = x[j];
#endif
}

void update_span(const Constants& c, const SeAdamTensor& t, int64_t begin, int64_t end) {
  const Vec rate1 = broadcast(c.rate1), beta2 = broadcast(c.beta2), rate2 = broadcast(c.rate2), eps = broadcast(c.eps),
            step = broadcast(-c.step_size), root = broadcast(c.root);
  int64_t i = begin;
  for (; i + LANES <= end; i += LANES) {
    const Vec g = load(t.gradient + i), old = load(t.first + i);
    const Vec first = fma(rate1, g - old, old);
    const Vec second = fma(rate2 * g, g, load(t.second + i) * beta2);
    store(t.first + i, first);
    store(t.second + i, second);
    store(t.value + i, load(t.value + i) + step * first / (square_root(second) / root + eps));
  }
  if (t.rows && i < end) {  // the rest of a row, which ends everywhere: one register
    const int64_t n = end - i;
    const Vec g = load_part(t.gradient + i, n), old = load_part(t.first + i, n);
    const Vec first = fma(rate1, g - old, old);
    const Vec second = fma(rate2 * g, g, load_part(t.second + i, n) * beta2);
    store_some(t.first + i, first, n);
    store_some(t.second + i, second, n);
    store_some(t.value + i, load_part(t.value + i, n) + step * first / (square_root(second) / root + eps), n);
    return;
  }
  // PyTorch's kernel works eight by eight; in what is left after that, its compiler fuses the other product.
  const int64_t eights = begin + (end - begin) / 8 * 8;
  for (; i < end; ++i) {
    const float g = t.gradient[i], scaled = c.rate2 * g;
    t.first[i] = std::fma(c.rate1, g - t.first[i], t.first[i]);
    t.second[i] = i < eights ? std::fma(scaled, g, t.second[i] * c.beta2) : std::fma(t.second[i], c.beta2, scaled * g);
    t.value[i] -= c.step_size * t.first[i] / (std::sqrt(t.second[i]) / c.root + c.eps);
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

// Neighbouring rows are one span, so that short rows do not end in a rest each.
void update_rows(const Constants& c, const SeAdamTensor& t, int64_t begin, int64_t end) {
  while (begin < end) {
    int64_t last = begin + 1;
    while (last < end && t.rows[last] == t.rows[last - 1] + 1) ++last;
    for (int64_t ahead = begin + kAhead; ahead < std::min(end, last + kAhead); ++ahead) prefetch_row(t, t.rows[ahead]);
    update_span(c, t, t.rows[begin] * t.width, (t.rows[last - 1] + 1) * t.width);
    begin = last;
  }
}

int64_t chunk_size(const SeAdamTensor& t) { return std::max<int64_t>(1, kGrain / std::max<int64_t>(1, t.width)); }

int64_t count_chunks(const SeAdamTensor& t) { return (t.count + chunk_size(t) - 1) / chunk_size(t); }

}  // namespace
}  // namespace se

// tensors [n]; where `rows` is given, each row at most once and inside of the tensor.
SE_EXPORT void se_adam_step(const SeAdamTensor* tensors, int64_t count, double beta1, double beta2, double eps, int32_t threads) {
  int64_t total = 0;
  for (int64_t i = 0; i < count; ++i) total += se::count_chunks(tensors[i]);
  const auto single = [](double x) { return static_cast<float>(x); };
  se::parallel_for(total, 1, threads, [&](int64_t chunk, int64_t, int) {
    const SeAdamTensor* t = tensors;
    for (; chunk >= se::count_chunks(*t); ++t) chunk -= se::count_chunks(*t);
    const se::Constants c{single(1 - beta1), single(beta2), single(1 - beta2), single(eps), single(t->step_size), single(t->root)};
    const int64_t from = chunk * se::chunk_size(*t), to = std::min(t->count, from + se::chunk_size(*t));
    if (t->rows)
      se::update_rows(c, *t, from, to);
    else
      se::update_span(c, *t, from, to);
  });
}
