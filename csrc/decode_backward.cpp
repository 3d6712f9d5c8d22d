// Backward pass of the fused decode. Hidden layers are computed again instead of stored. See decode.h.
#include <algorithm>
#include <cstring>

#include "decode.h"
#include "export.h"
#include "pool.h"
#include "products.h"

namespace {

using namespace se;

// Where the parts of one partial sum of weight gradients start, in floats.
struct Layout {
  struct Expert {
    int64_t w1t, w2, b2;  // [inputs][Hp] (with the bias as an input), [out][Hp], [Op]; rows rounded up to 16
  };
  std::vector<Expert> experts[3];
  int64_t router = 0, router_b = 0, total = 0;  // [R][Fp], [Rp]
  Layout(const Decode& d, const Sizes& s) {
    const auto take = [&](int64_t floats) { return (total += floats) - floats; };
    for (int i = 0; i < 3; ++i)
      for (int e = 0; e < d.heads[i].E; ++e) {
        const int64_t w1t = take(int64_t(round_up(s.inputs[i], 16)) * s.Hp[i]), w2 = take(int64_t(s.Op[i]) * s.Hp[i]);
        experts[i].push_back({w1t, w2, take(s.Op[i])});
      }
    router = take(int64_t(s.Rp) * s.Fp);
    router_b = take(s.Rp);
  }
};

class Backward {
 public:
  Backward(const Decode& d, const Sizes& s, const Packed& packed, const Layout& layout, float* sums)
      : d_(d), s_(s), packed_(packed), layout_(layout), sums_(sums) {}

  void run(int64_t begin, int64_t end) {
    Chunk chunk{begin, static_cast<int>(end - begin), nullptr};
    gather(d_, s_, chunk);
    const int64_t rows = CHUNK + SLACK;
    mixed_[0] = scratch(USE_MIXED, rows * (s_.Op[0] + s_.Op[1] + s_.Op[2]));
    mixed_[1] = mixed_[0] + rows * s_.Op[0], mixed_[2] = mixed_[1] + rows * s_.Op[1];
    for (int i = 0; i < 3; ++i) std::fill_n(mixed_[i], int64_t(chunk.n) * s_.Op[i], 0.f);
    gaussians(chunk);
    feature_ = scratch(USE_FEATURE, rows * s_.Fp);
    std::fill_n(feature_, int64_t(chunk.n) * s_.Fp, 0.f);
    logits_ = scratch(USE_LOGITS, rows * s_.Rp);
    std::fill_n(logits_, int64_t(chunk.n) * s_.Rp, 0.f);
    for (int i = 0; i < 3; ++i) head(chunk, i);
    if (s_.R) router(chunk);
    for (int a = 0; a < chunk.n; ++a) copy_row(feature_ + int64_t(a) * s_.Fp, s_.F, d_.d_feature + d_.rows[begin + a] * s_.F);
  }

 private:
  // Gradients of the emitted Gaussians -> of the mixed outputs, the log-scaling and the offsets.
  void gaussians(const Chunk& chunk) {
    const int K = static_cast<int>(d_.K);
    float* size = scratch(USE_SCALING, 18 * CHUNK + 2 * LANES);
    float *to_scaling = size + 6 * CHUNK + LANES, *inverse = to_scaling + 6 * CHUNK;
    scaling(d_, chunk, size);
    for (int j = 0; j < 6 * chunk.n; j += LANES) store(inverse + j, all(1.f) / load(size + j));
    std::fill_n(to_scaling, 6 * chunk.n, 0.f);
    for (int a = 0; a < chunk.n; ++a) {
      const int64_t anchor = chunk.begin + a;
      if (d_.ascending) clear_gap(anchor);
      std::fill_n(d_.d_offsets + d_.rows[anchor] * 3 * K, 3 * K, 0.f);
      if (d_.d_raw) copy_row(d_.d_raw + anchor * K, K, mixed_[0] + int64_t(a) * s_.Op[0]);
    }
    const int64_t first = d_.starts[chunk.begin / CHUNK];
    const Drawn all_drawn = drawn(d_, chunk);
    for (int i = 0; i < all_drawn.count; ++i) {
      const int a = all_drawn.anchor[i];
      gaussian(a, all_drawn.slot[i], first + i, d_.rows[chunk.begin + a], size + 6 * a, inverse + 6 * a, to_scaling + 6 * a);
    }
    if (d_.heads[0].single())
      for (int a = 0; a < chunk.n; ++a)
        for (int slot = 0; slot < K; ++slot) {
          const float sigma = d_.raw[(chunk.begin + a) * K + slot];
          mixed_[0][int64_t(a) * s_.Op[0] + slot] *= 1.f - sigma * sigma;
        }
    for (int a = 0; a < chunk.n; ++a)
      for (int j = 0; j < 6; ++j) d_.d_log_scaling[d_.rows[chunk.begin + a] * 6 + j] = to_scaling[6 * a + j];
  }

  void gaussian(int a, int slot, int64_t at, int64_t row, const float* l, const float* per_l, float* to_scaling) {
    float* to_cov = mixed_[1] + int64_t(a) * s_.Op[1] + COV * slot;
    float* to_color = mixed_[2] + int64_t(a) * s_.Op[2] + 3 * slot;
    const int64_t offset = (row * d_.K + slot) * 3;
    if (d_.d_opacities) mixed_[0][int64_t(a) * s_.Op[0] + slot] += d_.d_opacities[at];
    if (d_.d_means)
      for (int j = 0; j < 3; ++j) {
        const float g = d_.d_means[3 * at + j] * l[j];
        d_.d_offsets[offset + j] = g;
        to_scaling[j] += g * d_.offsets[offset + j];
      }
    if (d_.d_scales)
      for (int j = 0; j < 3; ++j) {
        const float scale = d_.scales[3 * at + j], g = d_.d_scales[3 * at + j] * scale;
        to_scaling[3 + j] += g;
        to_cov[j] = g * (1.f - scale * per_l[3 + j]);
      }
    if (d_.d_quats) {
      const float *q = d_.quats + 4 * at, *g = d_.d_quats + 4 * at, inverse = d_.per_length[at];
      // A length below 1e-12 was replaced by it, a constant.
      const float along = inverse < 1e12f ? q[0] * g[0] + q[1] * g[1] + q[2] * g[2] + q[3] * g[3] : 0.f;
      for (int j = 0; j < 4; ++j) to_cov[3 + j] = inverse * (g[j] - along * q[j]);
    }
    if (d_.d_colors)
      for (int j = 0; j < 3; ++j) {
        const float c = d_.colors[3 * at + j];
        to_color[j] = d_.d_colors[3 * at + j] * (d_.heads[2].single() ? c * (1.f - c) : 1.f);
      }
  }

  // Rows of the table between this anchor's and the one before it, and after the last: nobody else writes them.
  void clear_gap(int64_t anchor) {
    clear(anchor ? d_.rows[anchor - 1] + 1 : 0, d_.rows[anchor]);
    if (anchor == d_.A - 1) clear(d_.rows[anchor] + 1, d_.N);
  }

  void clear(int64_t from, int64_t to) {
    if (from >= to) return;
    std::fill(d_.d_feature + from * s_.F, d_.d_feature + to * s_.F, 0.f);
    std::fill(d_.d_log_scaling + from * 6, d_.d_log_scaling + to * 6, 0.f);
    std::fill(d_.d_offsets + from * d_.K * 3, d_.d_offsets + to * d_.K * 3, 0.f);
  }

  void head(const Chunk& chunk, int i) {
    const Head& head = d_.heads[i];
    const int shares = static_cast<int>(head.k ? head.k : head.E);
    int* lists = reinterpret_cast<int*>(scratch(USE_LISTS, int64_t(chunk.n) * (2 + 3 * shares)));
    float* weights = reinterpret_cast<float*>(lists + int64_t(chunk.n) * (2 + 2 * shares));  // gradient of the mixture's weights, [n][shares]
    for (const Group& g : groups(head, chunk, lists)) {
      const int step = block_size(g.n);
      for (int from = 0; from < g.n; from += step) block(chunk, i, g, from, std::min(step, g.n - from), weights, shares);
    }
    if (head.router_w) mixture(chunk, i, weights, shares);
  }

  // One expert on a block of its anchors.
  void block(const Chunk& chunk, int i, const Group& g, int from, int n, float* weights, int shares) {
    const Head& head = d_.heads[i];
    const Packed::Expert& expert = packed_.experts[i][g.expert];
    const Layout::Expert& at = layout_.experts[i][g.expert];
    const int Hp = s_.Hp[i], Op = s_.Op[i];
    const int64_t rows = BLOCK + SLACK;
    float* z = scratch(USE_BLOCK, rows * s_.Z);
    float* h = scratch(USE_HIDDEN, 2 * rows * Hp);
    float* y = scratch(USE_OUT, 2 * rows * Op);
    float *dh = h + rows * Hp, *dy = y + rows * Op;
    float* df = scratch(USE_GRADIENT, rows * s_.Fp);
    block_inputs(chunk, s_, g, from, n, z);
    hidden(expert, s_, i, n, z, h);
    if (!head.single() && i != 1) {
      outputs(expert, s_, i, n, h, y);
      activate(i, y, n * Op);
    }
    float* b2 = sums_ + at.b2;
    for (int t = 0; t < n; ++t) {
      const int a = g.anchor[from + t], slot = g.slot[from + t];
      const float w = head.single() ? 1.f : weight(head, chunk.begin + a, slot);
      const float along = output_gradient(i, w, mixed_[i] + int64_t(a) * Op, y + int64_t(t) * Op, expert.b2.data(), dy + int64_t(t) * Op, b2);
      weights[a * shares + slot % shares] = along;
    }
    product(n, Hp, s_.out[i], dy, Op, expert.w2.data(), Hp, nullptr, dh, Hp);
    for (int t = 0; t < n; ++t) {
      const int a = g.anchor[from + t], slot = g.slot[from + t];
      float *own = h + int64_t(t) * Hp, *down = dh + int64_t(t) * Hp;
      if (i == 1 && !head.single()) {  // dy is not weighted yet: the covariance is linear, so that <dy, y> = <dh, h> + <dy, b2>
        const V w = all(weight(head, chunk.begin + a, slot));
        V along = all(0.f);
        for (int j = 0; j < Hp; j += LANES) {
          const V x = load(own + j), gradient = load(down + j);
          along = fma(gradient, x, along);
          store(down + j, greater(x, all(0.f), gradient * w, all(0.f)));
          store(own + j, x * w);
        }
        weights[a * shares + slot % shares] += sum(along);
      } else {
        for (int j = 0; j < Hp; j += LANES) store(down + j, greater(load(own + j), all(0.f), load(down + j), all(0.f)));
      }
    }
    accumulate(n, s_.out[i], Hp, dy, Op, h, Hp, sums_ + at.w2, Hp);
    accumulate(n, s_.inputs[i], Hp, z, s_.Z, dh, Hp, sums_ + at.w1t, Hp);
    product(n, s_.Fp, s_.H[i], dh, Hp, expert.w1.data(), s_.Fp, nullptr, df, s_.Fp);
    for (int t = 0; t < n; ++t) {
      float* to = feature_ + int64_t(g.anchor[from + t]) * s_.Fp;
      for (int c = 0; c < s_.Fp; c += LANES) store(to + c, load(to + c) + load(df + int64_t(t) * s_.Fp + c));
    }
  }

  // Gradient of one expert's outputs before their activation (covariance: not weighted yet) and of its bias; returns <gradient, outputs>
  // for the mixture's weight (covariance: the bias's part of it).
  float output_gradient(int i, float w, const float* mixed, const float* y, const float* bias, float* dy, float* b2) const {
    const int Op = s_.Op[i];
    const V one = all(1.f), weight = all(w);
    V along = all(0.f);
    if (d_.heads[i].single()) {
      for (int o = 0; o < Op; o += LANES) {
        const V g = load(mixed + o);
        store(dy + o, g);
        store(b2 + o, load(b2 + o) + g);
      }
      return 0.f;
    }
    for (int o = 0; o < Op; o += LANES) {
      const V g = load(mixed + o);
      if (i == 1) {
        along = fma(g, load(bias + o), along);
        store(dy + o, g);
        store(b2 + o, fma(weight, g, load(b2 + o)));
      } else {
        const V v = load(y + o), slope = i == 0 ? one - v * v : v - v * v, down = weight * g * slope;
        along = fma(g, v, along);
        store(dy + o, down);
        store(b2 + o, load(b2 + o) + down);
      }
    }
    return sum(along);
  }

  // Gradients of the mixture's weights and of the gates -> of the logits.
  void mixture(const Chunk& chunk, int i, const float* weights, int shares) {
    const Head& head = d_.heads[i];
    const int E = static_cast<int>(head.E), k = static_cast<int>(head.k);
    for (int a = 0; a < chunk.n; ++a) {
      const int64_t anchor = chunk.begin + a;
      float* to = logits_ + int64_t(a) * s_.Rp + s_.first[i];
      const float* own = weights + int64_t(a) * shares;
      if (k > 1) {
        float mean = 0;
        for (int r = 0; r < k; ++r) mean += head.mix[anchor * k + r] * own[r];
        for (int r = 0; r < k; ++r) to[head.chosen[anchor * k + r]] += head.mix[anchor * k + r] * (own[r] - mean);
      }
      const float *gates = head.gates + anchor * E, *direct = head.d_gates ? head.d_gates + anchor * E : nullptr;
      if (k > 0 && !direct) continue;
      float mean = 0;
      for (int e = 0; e < E; ++e) mean += gates[e] * ((direct ? direct[e] : 0.f) + (k || E == 1 ? 0.f : own[e]));
      for (int e = 0; e < E; ++e) to[e] += gates[e] * ((direct ? direct[e] : 0.f) + (k || E == 1 ? 0.f : own[e]) - mean);
    }
  }

  void router(const Chunk& chunk) {
    float* df = scratch(USE_GRADIENT, int64_t(CHUNK + SLACK) * s_.Fp);
    product(chunk.n, s_.Fp, s_.R, logits_, s_.Rp, packed_.router.data(), s_.Fp, nullptr, df, s_.Fp);
    for (int64_t j = 0; j < int64_t(chunk.n) * s_.Fp; j += LANES) store(feature_ + j, load(feature_ + j) + load(df + j));
    accumulate(chunk.n, s_.R, s_.Fp, logits_, s_.Rp, chunk.z, s_.Z, sums_ + layout_.router, s_.Fp);
    float* bias = sums_ + layout_.router_b;
    for (int a = 0; a < chunk.n; ++a)
      for (int r = 0; r < s_.R; ++r) bias[r] += logits_[int64_t(a) * s_.Rp + r];
  }

  const Decode& d_;
  const Sizes& s_;
  const Packed& packed_;
  const Layout& layout_;
  float* sums_;
  float *mixed_[3], *feature_, *logits_;
};

// One expert's gradients in the order of its tensors.
void write_expert(const Decode& d, const Sizes& s, const Layout::Expert& at, const float* sums, int i, int e) {
  const Head& head = d.heads[i];
  const int H = s.H[i], Hp = s.Hp[i], out = s.out[i], D = s.F + 3 + static_cast<int>(head.distance);
  float *w1 = head.d_w1 + int64_t(e) * H * D, *b1 = head.d_b1 + int64_t(e) * H;
  float *w2 = head.d_w2 + int64_t(e) * out * H, *b2 = head.d_b2 + int64_t(e) * out;
  for (int j = 0; j < H; ++j) {
    for (int c = 0; c < D; ++c) w1[int64_t(j) * D + c] = sums[at.w1t + int64_t(c < s.F + 3 ? c : c + 1) * Hp + j];
    b1[j] = sums[at.w1t + int64_t(s.F + 3) * Hp + j];
  }
  for (int o = 0; o < out; ++o) std::copy_n(sums + at.w2 + int64_t(o) * Hp, H, w2 + int64_t(o) * H);
  std::copy_n(sums + at.b2, out, b2);
}

void write_routers(const Decode& d, const Sizes& s, const Layout& layout, const float* sums) {
  for (int i = 0; i < 3; ++i) {
    const Head& head = d.heads[i];
    if (!head.router_w) continue;
    for (int e = 0; e < head.E; ++e) {
      std::copy_n(sums + layout.router + int64_t(s.first[i] + e) * s.Fp, s.F, head.d_router_w + int64_t(e) * s.F);
      if (head.d_router_b) head.d_router_b[e] = sums[layout.router_b + s.first[i] + e];
    }
  }
}

}  // namespace

// Gradients of the table's rows and of all weights.
SE_EXPORT void se_decode_backward(const Decode* decode) {
  const Decode& d = *decode;
  const Sizes s(d);
  const Packed packed(d, s, true);
  const Layout layout(d, s);
  const int64_t grain = std::max<int64_t>(1, (d.chunks() + BUFFERS - 1) / BUFFERS) * CHUNK;
  const int64_t buffers = std::max<int64_t>(1, (d.A + grain - 1) / grain);
  std::vector<float> sums(buffers * layout.total, 0.f);
  const int threads = static_cast<int>(d.threads);
  parallel_for(d.A, grain, threads, [&](int64_t begin, int64_t end, int) {
    Backward pass(d, s, packed, layout, sums.data() + begin / grain * layout.total);
    for (int64_t at = begin; at < end; at += CHUNK) pass.run(at, std::min<int64_t>(end, at + CHUNK));
  });
  parallel_for(layout.total, 4096, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t b = 1; b < buffers; ++b)
      for (int64_t i = begin; i < end; ++i) sums[i] += sums[b * layout.total + i];
  });
  for (int i = 0; i < 3; ++i)
    for (int e = 0; e < d.heads[i].E; ++e) write_expert(d, s, layout.experts[i][e], sums.data(), i, e);
  write_routers(d, s, layout, sums.data());
}
