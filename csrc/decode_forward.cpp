// Forward pass of the fused decode: routing and opacities first, which say how many Gaussians there are; then the rest. See decode.h.
#include <algorithm>
#include <cmath>
#include <limits>

#include "decode.h"
#include "export.h"
#include "pool.h"
#include "products.h"

namespace {

using namespace se;

// Softmax over `count` rows of CHUNK lanes each, in place.
void softmax(float* rows, int count, int n) {
  for (int a = 0; a < n; a += LANES) {
    V largest = load(rows + a), total = all(0.f);
    for (int e = 1; e < count; ++e) largest = max(largest, load(rows + e * CHUNK + a));
    for (int e = 0; e < count; ++e) {
      const V x = exponential(load(rows + e * CHUNK + a) - largest);
      store(rows + e * CHUNK + a, x);
      total = total + x;
    }
    const V inverse = all(1.f) / total;
    for (int e = 0; e < count; ++e) store(rows + e * CHUNK + a, load(rows + e * CHUNK + a) * inverse);
  }
}

// The k largest of E rows of logits: their values and their places (as floats), largest first, ties to the lowest place. Spoils `logits`.
void choose(float* logits, int E, int k, int n, float* values, float* places) {
  for (int a = 0; a < n; a += LANES)
    for (int r = 0; r < k; ++r) {
      V best = load(logits + a), place = all(0.f);
      for (int e = 1; e < E; ++e) {
        const V x = load(logits + e * CHUNK + a);
        place = greater(x, best, all(float(e)), place);
        best = greater(x, best, x, best);
      }
      store(values + r * CHUNK + a, best);
      store(places + r * CHUNK + a, place);
      const V gone = all(-std::numeric_limits<float>::infinity());
      for (int e = 0; e < E; ++e) {
        const V x = load(logits + e * CHUNK + a);
        store(logits + e * CHUNK + a, greater(place, all(e - 0.5f), greater(all(e + 0.5f), place, gone, x), x));
      }
    }
}

// Gates, chosen experts and their weights for one chunk.
void route(const Decode& d, const Sizes& s, const Packed& packed, const Chunk& chunk) {
  if (!s.R) return;
  float* logits = scratch(USE_LOGITS, int64_t(CHUNK + SLACK) * s.Rp + 4 * int64_t(s.Rp) * CHUNK);
  float* across = logits + int64_t(CHUNK + SLACK) * s.Rp;  // [R][CHUNK]: anchors along the lanes
  product(chunk.n, s.Rp, s.F, chunk.z, s.Z, packed.router_t.data(), s.Rp, packed.router_b.data(), logits, s.Rp);
  for (int a = 0; a < chunk.n; ++a)
    for (int r = 0; r < s.R; ++r) across[r * CHUNK + a] = logits[a * s.Rp + r];
  for (int i = 0; i < 3; ++i) {
    const Head& head = d.heads[i];
    if (!head.router_w) continue;
    const int E = static_cast<int>(head.E), k = static_cast<int>(head.k), n = chunk.n;
    float* mine = across + s.first[i] * CHUNK;
    float *copy = across + s.Rp * CHUNK, *values = copy + s.Rp * CHUNK, *places = values + s.Rp * CHUNK;
    std::copy_n(mine, E * CHUNK, copy);
    softmax(mine, E, n);
    float* gates = head.gates + chunk.begin * E;
    for (int a = 0; a < n; ++a)
      for (int e = 0; e < E; ++e) gates[a * E + e] = mine[e * CHUNK + a];
    if (!k) continue;
    choose(copy, E, k, n, values, places);
    softmax(values, k, n);
    int64_t* chosen = head.chosen + chunk.begin * k;
    float* mix = head.mix + chunk.begin * k;
    for (int a = 0; a < n; ++a)
      for (int r = 0; r < k; ++r) {
        chosen[a * k + r] = static_cast<int64_t>(places[r * CHUNK + a]);
        mix[a * k + r] = values[r * CHUNK + a];
      }
  }
}

// Activated, mixed outputs of one head, [n][Op].
void decode_head(const Decode& d, const Sizes& s, const Packed& packed, const Chunk& chunk, int i, float* mixed) {
  const Head& head = d.heads[i];
  const int Op = s.Op[i], shares = static_cast<int>(head.k ? head.k : head.E);
  int* lists = reinterpret_cast<int*>(scratch(USE_LISTS, int64_t(chunk.n) * (2 + 2 * shares)));
  float* z = scratch(USE_BLOCK, int64_t(BLOCK + SLACK) * s.Z);
  float* h = scratch(USE_HIDDEN, int64_t(BLOCK + SLACK) * s.Hp[i]);
  float* y = scratch(USE_OUT, int64_t(BLOCK + SLACK) * Op);
  if (!head.single()) std::fill_n(mixed, int64_t(chunk.n) * Op, 0.f);
  for (const Group& g : groups(head, chunk, lists)) {
    const Packed::Expert& expert = packed.experts[i][g.expert];
    const int step = block_size(g.n);
    for (int from = 0; from < g.n; from += step) {
      const int n = std::min(step, g.n - from);
      block_inputs(chunk, s, g, from, n, z);
      hidden(expert, s, i, n, z, h);
      outputs(expert, s, i, n, h, y);
      activate(i, y, n * Op);
      for (int t = 0; t < n; ++t) {
        const int a = g.anchor[from + t];
        float *to = mixed + int64_t(a) * Op, *own = y + int64_t(t) * Op;
        if (head.single()) {
          for (int o = 0; o < Op; o += LANES) store(to + o, load(own + o));
        } else {
          const V w = all(weight(head, chunk.begin + a, g.slot[from + t]));
          for (int o = 0; o < Op; o += LANES) store(to + o, fma(w, load(own + o), load(to + o)));
        }
      }
    }
  }
}

Chunk chunk_at(const Decode& d, const Sizes& s, int64_t begin, int64_t end) {
  Chunk chunk{begin, static_cast<int>(end - begin), nullptr};
  gather(d, s, chunk);
  return chunk;
}

void sigmoid_all(float* x, int64_t count) {
  int64_t i = 0;
  for (; i + LANES <= count; i += LANES) store(x + i, sigmoid(load(x + i)));
  if (i == count) return;
  float tail[LANES] = {};
  std::copy(x + i, x + count, tail);
  store(tail, sigmoid(load(tail)));
  std::copy_n(tail, count - i, x + i);
}

// The Gaussians of one chunk from its mixed outputs, written from index `first` on.
void emit(const Decode& d, const Sizes& s, const Chunk& chunk, const float* cov, const float* color, int64_t first) {
  const int K = static_cast<int>(d.K);
  float* size = scratch(USE_SCALING, 6 * CHUNK + LANES);
  scaling(d, chunk, size);
  const Drawn all_drawn = drawn(d, chunk);
  float *means = d.means + 3 * first, *quats = d.quats + 4 * first, *scales = d.scales + 3 * first, *colors = d.colors + 3 * first;
  for (int i = 0; i < all_drawn.count; ++i) {
    const int a = all_drawn.anchor[i], slot = all_drawn.slot[i];
    const int64_t row = d.rows[chunk.begin + a];
    const float *x = d.xyz + row * 3, *offset = d.offsets + (row * K + slot) * 3, *l = size + 6 * a;
    const float *y = cov + int64_t(a) * s.Op[1] + COV * slot, *c = color + int64_t(a) * s.Op[2] + 3 * slot;
    d.opacities[first + i] = d.raw[(chunk.begin + a) * K + slot];
    d.source[first + i] = row * K + slot;
    for (int j = 0; j < 3; ++j) means[3 * i + j] = x[j] + offset[j] * l[j];
    for (int j = 0; j < 3; ++j) colors[3 * i + j] = c[j];
    for (int j = 0; j < 3; ++j) scales[3 * i + j] = y[j];
    const float length = std::sqrt(y[3] * y[3] + y[4] * y[4] + y[5] * y[5] + y[6] * y[6]), inverse = 1.f / std::max(length, 1e-12f);
    for (int j = 0; j < 4; ++j) quats[4 * i + j] = y[3 + j] * inverse;
    d.per_length[first + i] = inverse;
  }
  sigmoid_all(scales, 3 * int64_t(all_drawn.count));
  for (int i = 0; i < all_drawn.count; ++i)
    for (int j = 0; j < 3; ++j) scales[3 * i + j] *= size[6 * all_drawn.anchor[i] + 3 + j];
}

}  // namespace

// Routing and raw opacities of all anchors. Fills starts and returns the number of Gaussians with positive opacity.
SE_EXPORT int64_t se_decode_begin(const Decode* decode) {
  const Decode& d = *decode;
  const Sizes s(d);
  const Packed packed(d, s, false);
  parallel_for(d.A, CHUNK, static_cast<int>(d.threads), [&](int64_t begin, int64_t end, int) {
    const Chunk chunk = chunk_at(d, s, begin, end);
    route(d, s, packed, chunk);
    float* mixed = scratch(USE_MIXED, int64_t(CHUNK + SLACK) * s.Op[0]);
    decode_head(d, s, packed, chunk, 0, mixed);
    int64_t drawn = 0;
    for (int a = 0; a < chunk.n; ++a)
      for (int k = 0; k < d.K; ++k) {
        const float sigma = mixed[int64_t(a) * s.Op[0] + k];
        d.raw[(begin + a) * d.K + k] = sigma;
        drawn += sigma > 0.f;
      }
    d.starts[begin / CHUNK + 1] = drawn;
  });
  d.starts[0] = 0;
  for (int64_t c = 0; c < d.chunks(); ++c) d.starts[c + 1] += d.starts[c];
  return d.starts[d.chunks()];
}

// Covariances and colours, and all Gaussians of positive opacity in the order of anchors and slots.
SE_EXPORT void se_decode_emit(const Decode* decode) {
  const Decode& d = *decode;
  const Sizes s(d);
  const Packed packed(d, s, false);
  parallel_for(d.A, CHUNK, static_cast<int>(d.threads), [&](int64_t begin, int64_t end, int) {
    const int64_t at = d.starts[begin / CHUNK];
    if (d.starts[begin / CHUNK + 1] == at) return;
    const Chunk chunk = chunk_at(d, s, begin, end);
    const int64_t covs = int64_t(CHUNK + SLACK) * s.Op[1];
    float* cov = scratch(USE_MIXED, covs + int64_t(CHUNK + SLACK) * s.Op[2]);
    decode_head(d, s, packed, chunk, 1, cov);
    decode_head(d, s, packed, chunk, 2, cov + covs);
    emit(d, s, chunk, cov, cov + covs, at);
  });
}
