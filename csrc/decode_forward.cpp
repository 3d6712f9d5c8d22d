// Forward pass of the fused decode. se_decode_begin computes routing and opacities, which give the number of
// Gaussians; se_decode_emit computes the rest. See decode.h.
#include <algorithm>

#include "decode.h"
#include "pool.h"
#include "products.h"
#include "se_api.h"
#include "status.h"

namespace {

using namespace se;

// Compute the activated, mixed outputs of one head, [n][Op].
void decode_head(const Decode& d, const Sizes& s, const Packed& packed, const Chunk& chunk, int i, std::vector<Group>& found, Work& w) {
  const Head& head = d.heads[i];
  const int Op = s.Op[i];
  float *mixed = w.mixed[i], *y = w.out;
  group_by_expert(d, head, chunk, i > 0, w, found);
  if (!has_one_expert(head)) std::fill_n(mixed, int64_t(chunk.n) * Op, 0.f);
  for (const Group& g : found) {
    const Packed::Expert& expert = packed.experts[i][g.expert];
    const int step = block_size(g.n);
    for (int from = 0; from < g.n; from += step) {
      const int n = std::min(step, g.n - from);
      const int* anchor = w.anchor + g.first + from;
      const float* weight = w.weight + g.first + from;
      copy_block_inputs(w, s, g, from, n);
      float* h = compute_hidden(expert, s, i, static_cast<int>(head.L), n, w);
      compute_outputs(expert, s, i, n, h, y);
      activate(i, y, n * Op);
      for (int t = 0; t < n; ++t) {
        float *to = mixed + int64_t(anchor[t]) * Op, *own = y + int64_t(t) * Op;
        if (has_one_expert(head)) {
          for (int o = 0; o < Op; o += LANES) store(to + o, load(own + o));
        } else {
          const Vec share = broadcast(weight[t]);
          for (int o = 0; o < Op; o += LANES) store(to + o, fma(share, load(own + o), load(to + o)));
        }
      }
    }
  }
}

// Call f(sizes, packed weights, chunk, workspace) for each chunk of anchors, on all threads. Return 1 if memory
// runs out.
template <class F>
int for_each_chunk(const Decode& d, F&& f) {
  return run_guarded([&] {
    const Sizes s(d);
    const Packed packed(d, s, false);
    parallel_for(d.A, CHUNK, static_cast<int>(d.threads), [&](int64_t begin, int64_t end, int) {
      Work w(s);
      f(s, packed, Chunk{begin, static_cast<int>(end - begin)}, w);
    });
  });
}

}  // namespace

SE_EXPORT int32_t se_decode_begin(const Decode* decode) {
  const Decode& d = *decode;
  const int code = for_each_chunk(d, [&](const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
    std::vector<Group> found;
    gather(d, s, chunk, w);
    if (!d.frozen) route(d, s, packed, chunk, w);
    decode_head(d, s, packed, chunk, 0, found, w);
    int64_t drawn = 0;
    for (int a = 0; a < chunk.n; ++a) {
      copy_row(w.mixed[0] + int64_t(a) * s.Op[0], s.K, d.raw + (chunk.begin + a) * s.K);
      if (d.slots) {
        const uint8_t* open = d.slots + d.rows[chunk.begin + a] * s.K;
        for (int slot = 0; slot < s.K; ++slot) drawn += w.mixed[0][int64_t(a) * s.Op[0] + slot] > 0.f && open[slot];
        continue;
      }
      for (int slot = 0; slot < s.K; slot += LANES)
        drawn += __builtin_popcount(find_positive(load_part(w.mixed[0] + int64_t(a) * s.Op[0] + slot, std::min(LANES, s.K - slot))));
    }
    d.starts[chunk.begin / CHUNK + 1] = drawn;
  });
  if (code) return code;  // the counts are incomplete
  d.starts[0] = 0;
  for (int64_t c = 0; c < count_chunks(d); ++c) d.starts[c + 1] += d.starts[c];
  return 0;
}

SE_EXPORT int32_t se_decode_emit(const Decode* decode) {
  const Decode& d = *decode;
  return for_each_chunk(d, [&](const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
    const int64_t at = d.starts[chunk.begin / CHUNK];
    if (d.starts[chunk.begin / CHUNK + 1] == at) return;
    std::vector<Group> found;
    gather(d, s, chunk, w);
    find_drawn(d, chunk, w);
    decode_head(d, s, packed, chunk, 1, found, w);
    decode_head(d, s, packed, chunk, 2, found, w);
    emit_gaussians(d, s, chunk, at, w);
  });
}

SE_EXPORT int32_t se_decode_route(const Decode* decode) {
  const Decode& d = *decode;
  return for_each_chunk(d, [&](const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
    gather(d, s, chunk, w);
    route(d, s, packed, chunk, w);
  });
}

SE_EXPORT int64_t se_decode_chunks(int64_t anchors) { return (anchors + CHUNK - 1) / CHUNK; }
