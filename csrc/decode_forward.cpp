// Forward pass of the fused decode: routing and opacities first, which say how many Gaussians there are; then the rest. See decode.h.
#include <algorithm>

#include "decode.h"
#include "export.h"
#include "pool.h"
#include "products.h"

namespace {

using namespace se;

// Activated, mixed outputs of one head, [n][Op].
void decode_head(const Decode& d, const Sizes& s, const Packed& packed, const Chunk& chunk, int i, std::vector<Group>& found, Work& w) {
  const Head& head = d.heads[i];
  const int Op = s.Op[i];
  float *mixed = w.mixed[i], *y = w.out;
  groups(d, head, chunk, i > 0, w, found);
  if (!head.single()) std::fill_n(mixed, int64_t(chunk.n) * Op, 0.f);
  for (const Group& g : found) {
    const Packed::Expert& expert = packed.experts[i][g.expert];
    const int step = block_size(g.n);
    for (int from = 0; from < g.n; from += step) {
      const int n = std::min(step, g.n - from);
      const int* anchor = w.anchor + g.first + from;
      const float* weight = w.weight + g.first + from;
      float* h;
      if (head.base) {
        h = hidden_from_base(d, expert, s, chunk, i, anchor, w.place + g.first + from, n, w);
      } else {
        block_inputs(w, s, g, from, n);
        h = hidden(expert, s, i, static_cast<int>(head.L), n, w);
      }
      outputs(expert, s, i, n, h, y);
      activate(i, y, n * Op);
      for (int t = 0; t < n; ++t) {
        float *to = mixed + int64_t(anchor[t]) * Op, *own = y + int64_t(t) * Op;
        if (head.single()) {
          for (int o = 0; o < Op; o += LANES) store(to + o, load(own + o));
        } else {
          const V share = all(weight[t]);
          for (int o = 0; o < Op; o += LANES) store(to + o, fma(share, load(own + o), load(to + o)));
        }
      }
    }
  }
}

// Asks for the features' part of the first layer of heads from .. to - 1: its rows are read expert by expert, which no prefetcher foresees.
void fetch_base(const Decode& d, const Sizes& s, const Chunk& chunk, int from, int to) {
  for (int i = from; i < to; ++i) {
    if (!d.heads[i].base) continue;
    const int64_t row = int64_t(d.heads[i].shares()) * s.Hp[i];
    for (int a = 0; a < chunk.n; ++a)
      for (int64_t c = 0; c < row; c += 16) __builtin_prefetch(d.heads[i].base + d.rows[chunk.begin + a] * row + c);
  }
}

// Calls f(sizes, packed weights, chunk, room to work in) for each chunk of anchors, on all threads; returns 1 where memory ran out.
template <class F>
int each_chunk(const Decode& d, F&& f) {
  return guarded([&] {
    const Sizes s(d);
    const Packed packed(d, s, false);
    parallel_for(d.A, CHUNK, static_cast<int>(d.threads), [&](int64_t begin, int64_t end, int) {
      Work w(s);
      f(s, packed, Chunk{begin, static_cast<int>(end - begin)}, w);
    });
  });
}

}  // namespace

// The exported functions return 1 where memory ran out.

// Routing and raw opacities of all anchors. Fills starts; the last is the number of Gaussians with positive opacity.
SE_EXPORT int se_decode_begin(const Decode* decode) {
  const Decode& d = *decode;
  const int code = each_chunk(d, [&](const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
    std::vector<Group> found;
    gather(d, s, chunk, w);
    if (d.frozen)
      fetch_base(d, s, chunk, 0, 1);
    else
      route(d, s, packed, chunk, w);
    decode_head(d, s, packed, chunk, 0, found, w);
    int64_t drawn = 0;
    for (int a = 0; a < chunk.n; ++a) {
      copy_row(w.mixed[0] + int64_t(a) * s.Op[0], s.K, d.raw + (chunk.begin + a) * s.K);
      for (int slot = 0; slot < s.K; slot += LANES)
        drawn += __builtin_popcount(positive(load_part(w.mixed[0] + int64_t(a) * s.Op[0] + slot, std::min(LANES, s.K - slot))));
    }
    d.starts[chunk.begin / CHUNK + 1] = drawn;
  });
  if (code) return code;  // the counts are not whole
  d.starts[0] = 0;
  for (int64_t c = 0; c < d.chunks(); ++c) d.starts[c + 1] += d.starts[c];
  return 0;
}

// Covariances and colours, and all Gaussians of positive opacity in the order of anchors and slots.
SE_EXPORT int se_decode_emit(const Decode* decode) {
  const Decode& d = *decode;
  return each_chunk(d, [&](const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
    const int64_t at = d.starts[chunk.begin / CHUNK];
    if (d.starts[chunk.begin / CHUNK + 1] == at) return;
    std::vector<Group> found;
    gather(d, s, chunk, w);
    if (d.frozen) fetch_base(d, s, chunk, 1, 3);
    find_drawn(d, chunk, w);
    decode_head(d, s, packed, chunk, 1, found, w);
    decode_head(d, s, packed, chunk, 2, found, w);
    emit(d, s, chunk, at, w);
  });
}

// Gates, chosen experts and their weights of all anchors.
SE_EXPORT int se_decode_route(const Decode* decode) {
  const Decode& d = *decode;
  return each_chunk(d, [&](const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
    gather(d, s, chunk, w);
    route(d, s, packed, chunk, w);
  });
}

// The features' part of the first layer, sum over the feature of W1 f, for every row of the table and the experts it chose: heads' base.
// rows are 0 .. N - 1; gates, chosen and mix are given.
SE_EXPORT int se_decode_fold(const Decode* decode) {
  const Decode& d = *decode;
  return each_chunk(d, [&](const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
    std::vector<Group> found;
    for (int a = 0; a < chunk.n; ++a) copy_row(d.feature + d.rows[chunk.begin + a] * s.F, s.F, w.z + int64_t(a) * s.Z);
    for (int i = 0; i < 3; ++i) {
      const Head& head = d.heads[i];
      const int Hp = s.Hp[i];
      groups(d, head, chunk, false, w, found);
      for (const Group& g : found) {
        const int step = block_size(g.n);
        for (int from = 0; from < g.n; from += step) {
          const int n = std::min(step, g.n - from);
          block_inputs(w, s, g, from, n);
          product(n, Hp, s.F, w.block, s.Z, packed.experts[i][g.expert].w1t.data(), Hp, nullptr, Store{w.hidden, Hp});
          for (int t = 0; t < n; ++t)
            copy_row(w.hidden + int64_t(t) * Hp, Hp, head.base + (chunk.begin * head.shares() + w.place[g.first + from + t]) * Hp);
        }
      }
    }
  });
}
