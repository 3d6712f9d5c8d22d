// From mixed outputs to Gaussians and back, one mean, scale, quaternion and colour at a time. See decode.h.
#include <algorithm>
#include <cmath>

#include "decode.h"
#include "quad.h"

namespace se {

void emit_gaussians(const Decode& d, const Sizes& s, const Chunk& chunk, int64_t first, Work& w) {
  const int K = s.K;
  compute_sizes(d, chunk, w);
  int64_t at = first;
  for (int a = 0; a < chunk.n; ++a) {
    if (!w.live[a]) continue;
    const int64_t row = d.rows[chunk.begin + a];
    const F32x4 x = load3(d.xyz + row * 3), reach = load4(w.size + 8 * a), size = load4(w.size + 8 * a + 4);
    const float *offsets = find_offsets(d, row, w), *raw = d.raw + (chunk.begin + a) * K;
    const float *cov = w.mixed[1] + int64_t(a) * s.Op[1], *color = w.mixed[2] + int64_t(a) * s.Op[2];
    for_each_drawn(w, K, a, [&](int slot) {
      const F32x4 q = load4(cov + COV * slot + 3);
      const float inverse = 1.f / std::max(std::sqrt(dot(q, q)), 1e-12f);
      store3(d.means + 3 * at, x + load3(offsets + 3 * slot) * reach);
      store3(d.colors + 3 * at, load3(color + 3 * slot));
      store3(d.scales + 3 * at, load3(cov + COV * slot));
      store4(w.spread + 3 * (at - first), size);
      store4(d.quats + 4 * at, q * broadcast4(inverse));
      d.opacities[at] = raw[slot];
      d.per_length[at] = inverse;
      d.source[at] = row * K + slot;
      ++at;
    });
  }
  float* scales = d.scales + 3 * first;
  const int64_t count = 3 * (at - first);
  for (int64_t i = 0; i < count; i += LANES) {
    const int n = static_cast<int>(std::min<int64_t>(LANES, count - i));
    store_part(scales + i, sigmoid(load_part(scales + i, n)) * load(w.spread + i), n);
  }
}

namespace {

void clear_rows(const Decode& d, int64_t from, int64_t to) {
  if (from >= to) return;
  std::fill(d.d_feature + from * d.F, d.d_feature + to * d.F, 0.f);
  std::fill(d.d_log_scaling + from * 6, d.d_log_scaling + to * 6, 0.f);
  std::fill(d.d_offsets + from * d.K * 3, d.d_offsets + to * d.K * 3, 0.f);
}

// Clear the rows of the table between the previous anchor and this one, and those after the last anchor. No
// other worker writes them.
void clear_gap(const Decode& d, int64_t anchor) {
  clear_rows(d, anchor ? d.rows[anchor - 1] + 1 : 0, d.rows[anchor]);
  if (anchor == d.A - 1) clear_rows(d, d.rows[anchor] + 1, d.N);
}

}  // namespace

void differentiate_gaussians(const Decode& d, const Sizes& s, const Chunk& chunk, Work& w, float* step_sums) {
  const int K = s.K;
  compute_sizes(d, chunk, w);
  int64_t at = d.starts[chunk.begin / CHUNK];
  for (int a = 0; a < chunk.n; ++a) {
    const int64_t anchor = chunk.begin + a, row = d.rows[anchor];
    float *opacity = w.mixed[0] + int64_t(a) * s.Op[0], *d_offsets = d.d_offsets + row * K * 3;
    if (d.ascending) clear_gap(d, anchor);
    zero_row(d_offsets, 3 * K);
    const float *raw = d.raw + anchor * K, *d_raw = d.d_raw ? d.d_raw + anchor * K : nullptr;
    for (int slot = 0; slot < s.Op[0]; slot += LANES) {
      const int n = std::max(0, std::min(LANES, K - slot));
      const Vec sigma = load_part(raw + slot, n), g = d_raw ? load_part(d_raw + slot, n) : broadcast(0.f);
      store(opacity + slot, has_one_expert(d.heads[0]) ? g * (broadcast(1.f) - sigma * sigma) : g);
    }
    F32x4 to_reach = broadcast4(0.f), to_size = broadcast4(0.f);
    if (w.live[a]) {
      float *cov = w.mixed[1] + int64_t(a) * s.Op[1], *color = w.mixed[2] + int64_t(a) * s.Op[2];
      const F32x4 reach = load4(w.size + 8 * a), inverse = broadcast4(1.f) / load4(w.size + 8 * a + 4);
      zero_row(cov, s.Op[1]);
      zero_row(color, s.Op[2]);
      const float* offsets = find_offsets(d, row, w);
      for_each_drawn(w, K, a, [&](int slot) {
        if (d.d_opacities) {  // not added to the value just stored: a load after a wider masked store stalls
          const float g = d.d_opacities[at] + (d_raw ? d_raw[slot] : 0.f);
          opacity[slot] = has_one_expert(d.heads[0]) ? g * (1.f - raw[slot] * raw[slot]) : g;
        }
        if (d.d_means) {
          const F32x4 g = load3(d.d_means + 3 * at) * reach;
          store3(d_offsets + 3 * slot, g);
          to_reach += g * load3(offsets + 3 * slot);
        }
        if (d.d_scales) {
          const F32x4 scale = load3(d.scales + 3 * at), g = load3(d.d_scales + 3 * at) * scale;
          to_size += g;
          store3(cov + COV * slot, g * (broadcast4(1.f) - scale * inverse));
        }
        if (d.d_quats) {
          const F32x4 q = load4(d.quats + 4 * at), g = load4(d.d_quats + 4 * at);
          const float per_length = d.per_length[at];
          // Lengths below 1e-12 are replaced by this constant, which has no gradient.
          const float along = per_length < 1e12f ? dot(q, g) : 0.f;
          store4(cov + COV * slot + 3, broadcast4(per_length) * (g - broadcast4(along) * q));
        }
        if (d.d_colors) {
          const F32x4 g = load3(d.d_colors + 3 * at), c = load3(d.colors + 3 * at);
          store3(color + 3 * slot, has_one_expert(d.heads[2]) ? g * (c - c * c) : g);
        }
        ++at;
      });
      if (d.steps) add_step_gradients(d_offsets, offsets, d.offsets + row * K * 3, 3 * K, step_sums + d.F + 6);
    }
    store3(d.d_log_scaling + row * 6, to_reach);
    store3(d.d_log_scaling + row * 6 + 3, to_size);
    if (d.steps) {
      float rounded[6];
      round_scaling(d, row, rounded);
      add_step_gradients(d.d_log_scaling + row * 6, rounded, d.log_scaling + row * 6, 6, step_sums + d.F);
    }
  }
}

}  // namespace se
