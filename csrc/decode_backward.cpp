// Backward pass of the fused decode. It recomputes hidden layers instead of storing them. See decode.h.
#include <algorithm>
#include <memory>

#include "decode.h"
#include "pool.h"
#include "products.h"
#include "se_api.h"
#include "status.h"

namespace {

using namespace se;

// Offsets of the parts of one partial sum of weight gradients, in floats.
struct Layout {
  struct Expert {
    int64_t w1t, wm, bm, w2, b2;  // [inputs][Hp] with the bias as an input, [L][H][Hp], [L][Hp], [out][Hp], [Op]; rows padded to 16
  };
  std::vector<Expert> experts[3];
  int64_t router = 0, router_b = 0, steps = 0, total = 0;  // [R][routerp], [Rp], [F + 6 + 3 K]
  Layout(const Decode& d, const Sizes& s) {
    const auto take = [&](int64_t floats) { return (total += floats) - floats; };
    for (int i = 0; i < 3; ++i)
      for (int e = 0; e < d.heads[i].E; ++e) {
        Expert x;
        x.w1t = take(int64_t(round_up(s.inputs[i], 16)) * s.Hp[i]);
        x.wm = take(d.heads[i].L * s.Hp[i] * s.Hp[i]);
        x.bm = take(d.heads[i].L * s.Hp[i]);
        x.w2 = take(int64_t(s.Op[i]) * s.Hp[i]);
        x.b2 = take(s.Op[i]);
        experts[i].push_back(x);
      }
    router = take(int64_t(s.Rp) * s.routerp);
    router_b = take(s.Rp);
    steps = take(d.steps ? round_up(s.F + 6 + 3 * s.K, 16) : 0);
  }
};

// Add the sum of n rows: to[j] += sum_i rows[i][j].
void add_rows(int n, int width, const float* rows, int stride, float* to) {
  for (int j = 0; j < width; j += LANES) {
    Vec even = load(to + j), odd = broadcast(0.f);
    int i = 0;
    for (; i + 2 <= n; i += 2) {
      even = even + load(rows + int64_t(i) * stride + j);
      odd = odd + load(rows + int64_t(i + 1) * stride + j);
    }
    if (i < n) even = even + load(rows + int64_t(i) * stride + j);
    store(to + j, even + odd);
  }
}

class Backward {
 public:
  Backward(const Decode& d, const Sizes& s, const Packed& packed, const Layout& layout, float* sums)
      : d_(d), s_(s), packed_(packed), layout_(layout), sums_(sums), w_(s) {}

  void run(int64_t begin, int64_t end) {
    const Chunk chunk{begin, static_cast<int>(end - begin)};
    gather(d_, s_, chunk, w_);
    find_drawn(d_, chunk, w_);
    differentiate_gaussians(d_, s_, chunk, w_, sums_ + layout_.steps);
    std::fill_n(w_.feature, int64_t(chunk.n) * s_.Fp, 0.f);
    for (int i = 0; i < 3; ++i) differentiate_head(chunk, i);
    if (s_.R) differentiate_router(chunk);
    for (int a = 0; a < chunk.n; ++a) {
      const float* gradient = w_.feature + int64_t(a) * s_.Fp;
      copy_row(gradient, s_.F, d_.d_feature + d_.rows[begin + a] * s_.F);
      const float* exact = d_.feature + d_.rows[begin + a] * s_.F;
      if (d_.steps) add_step_gradients(gradient, w_.z + int64_t(a) * s_.Z, exact, s_.F, sums_ + layout_.steps);
    }
  }

 private:
  void differentiate_head(const Chunk& chunk, int i) {
    const Head& head = d_.heads[i];
    group_by_expert(d_, head, chunk, i > 0 || !d_.d_raw, w_, found_);
    if (!has_one_expert(head)) std::fill_n(w_.weights, int64_t(chunk.n) * experts_per_anchor(head), 0.f);
    for (const Group& g : found_) {
      const int step = block_size(g.n);
      for (int from = 0; from < g.n; from += step) differentiate_block(i, g, from, std::min(step, g.n - from));
    }
    if (head.router_w)
      differentiate_routing(d_, s_, chunk, i, w_);
    else if (head.d_weight)  // routed outside
      std::copy_n(w_.weights, int64_t(chunk.n) * experts_per_anchor(head), head.d_weight + chunk.begin * experts_per_anchor(head));
  }

  // Differentiate one expert on a block of its anchors.
  void differentiate_block(int i, const Group& g, int from, int n) {
    const Head& head = d_.heads[i];
    const Packed::Expert& expert = packed_.experts[i][g.expert];
    const Layout::Expert& at = layout_.experts[i][g.expert];
    const int H = s_.H[i], Hp = s_.Hp[i], Op = s_.Op[i], L = static_cast<int>(head.L);
    const int64_t layer = int64_t(BLOCK + SLACK) * Hp;
    const float* weight = w_.weight + g.first + from;
    const int *anchor = w_.anchor + g.first + from, *place = w_.place + g.first + from;
    copy_block_inputs(w_, s_, g, from, n);
    float *h = compute_hidden(expert, s_, i, L, n, w_), *dh = h + layer, *other = dh + layer, *y = w_.out,
          *dy = y + int64_t(BLOCK + SLACK) * Op;
    if (!has_one_expert(head) && !mixes_linearly(i)) {
      compute_outputs(expert, s_, i, n, h, y);
      activate(i, y, n * Op);
    }
    compute_output_gradients(i, n, anchor, place, weight, expert.b2.data(), y, dy);
    multiply(n, Hp, s_.out[i], dy, Op, expert.w2.data(), Hp, nullptr, Store{dh, Hp});
    if (mixes_linearly(i) && !has_one_expert(head))
      apply_weights(n, Hp, Op, place, weight, h, dh, dy, sums_ + at.b2);
    else {
      mask_relu(n * Hp, h, dh);
      add_rows(n, Op, dy, Op, sums_ + at.b2);
    }
    accumulate(n, s_.out[i], Hp, dy, Op, h, Hp, sums_ + at.w2, Hp);
    for (int l = L - 1; l >= 0; --l) {
      h -= layer;
      add_rows(n, Hp, dh, Hp, sums_ + at.bm + l * Hp);
      accumulate(n, H, Hp, dh, Hp, h, Hp, sums_ + at.wm + l * Hp * Hp, Hp);
      multiply(n, Hp, H, dh, Hp, expert.wm.data() + int64_t(l) * H * Hp, Hp, nullptr, Store{other, Hp});
      std::swap(dh, other);
      mask_relu(n * Hp, h, dh);
    }
    accumulate(n, s_.inputs[i], Hp, w_.block, s_.Z, dh, Hp, sums_ + at.w1t, Hp);
    int rows[BLOCK + SLACK];
    std::copy_n(anchor, n, rows);
    std::fill_n(rows + n, SLACK, CHUNK);  // a row that is never read
    multiply(n, s_.Fp, H, dh, Hp, expert.w1.data(), s_.Fp, nullptr, AddToRows{w_.feature, s_.Fp, rows});
  }

  // Compute the gradients of one expert's outputs before their activation (linear mixtures: before the mixture
  // weight is applied) and <gradient, outputs> for the gradient of the mixture weights (linear mixtures: only the
  // bias's part).
  void compute_output_gradients(int i, int n, const int* anchor, const int* place, const float* weight, const float* bias, const float* y,
                                float* dy) {
    const int Op = s_.Op[i];
    const bool single = has_one_expert(d_.heads[i]), linear = mixes_linearly(i);
    for (int t = 0; t < n; ++t, y += Op, dy += Op) {
      const float* given = w_.mixed[i] + int64_t(anchor[t]) * Op;
      const Vec share = broadcast(weight[t]);
      Vec along = broadcast(0.f);
      for (int o = 0; o < Op; o += LANES) {
        const Vec g = load(given + o);
        if (single) {
          store(dy + o, g);
        } else if (linear) {
          along = fma(g, load(bias + o), along);
          store(dy + o, g);
        } else {
          const Vec v = load(y + o);
          along = fma(g, v, along);
          store(dy + o, share * g * (i == 0 ? broadcast(1.f) - v * v : v - v * v));
        }
      }
      if (!single) w_.weights[place[t]] = sum(along);
    }
  }

  static void mask_relu(int n, const float* h, float* dh) {
    for (int j = 0; j < n; j += LANES) store(dh + j, select_greater(load(h + j), broadcast(0.f), load(dh + j), broadcast(0.f)));
  }

  // The mixture is linear, so <dy, y> = <dh, h> + <dy, b2> and its outputs need not be recomputed. Then
  // apply the mixture weights.
  void apply_weights(int n, int Hp, int Op, const int* place, const float* weight, float* h, float* dh, const float* dy, float* b2) {
    for (int t = 0; t < n; ++t, h += Hp, dh += Hp) {
      const Vec share = broadcast(weight[t]);
      Vec along = broadcast(0.f);
      for (int j = 0; j < Hp; j += LANES) {
        const Vec x = load(h + j), gradient = load(dh + j);
        along = fma(gradient, x, along);
        store(dh + j, select_greater(x, broadcast(0.f), gradient * share, broadcast(0.f)));
        store(h + j, x * share);
      }
      w_.weights[place[t]] += sum(along);
    }
    for (int o = 0; o < Op; o += LANES) {
      Vec total = load(b2 + o);
      for (int t = 0; t < n; ++t) total = fma(broadcast(weight[t]), load(dy + int64_t(t) * Op + o), total);
      store(b2 + o, total);
    }
  }

  void differentiate_router(const Chunk& chunk) {
    int rows[CHUNK + SLACK];
    for (int a = 0; a < CHUNK + SLACK; ++a) rows[a] = a < chunk.n ? a : CHUNK;
    multiply(chunk.n, s_.Fp, s_.R, w_.logits, s_.Rp, packed_.router.data(), s_.Fp, nullptr, AddToRows{w_.feature, s_.Fp, rows});
    accumulate(chunk.n, s_.R, s_.routerp, w_.logits, s_.Rp, w_.z, s_.Z, sums_ + layout_.router, s_.routerp);
    add_rows(chunk.n, s_.Rp, w_.logits, s_.Rp, sums_ + layout_.router_b);
  }

  const Decode& d_;
  const Sizes& s_;
  const Packed& packed_;
  const Layout& layout_;
  float* sums_;
  Work w_;
  std::vector<Group> found_;
};

// Write one expert's gradients in the layout of its tensors.
void write_expert(const Decode& d, const Sizes& s, const Layout::Expert& at, const float* sums, int i, int e) {
  const Head& head = d.heads[i];
  const int H = s.H[i], Hp = s.Hp[i], out = s.out[i], D = s.F + 3 + static_cast<int>(head.distance);
  float *w1 = head.d_w1 + int64_t(e) * H * D, *b1 = head.d_b1 + int64_t(e) * H;
  float *w2 = head.d_w2 + int64_t(e) * out * H, *b2 = head.d_b2 + int64_t(e) * out;
  for (int j = 0; j < H; ++j) {
    for (int c = 0; c < D; ++c) w1[int64_t(j) * D + c] = sums[at.w1t + int64_t(c < s.F + 3 ? c : c + 1) * Hp + j];
    b1[j] = sums[at.w1t + int64_t(s.F + 3) * Hp + j];
  }
  for (int64_t l = 0; l < head.L; ++l) {
    float *wm = head.d_middle_w + (e * head.L + l) * H * H, *bm = head.d_middle_b + (e * head.L + l) * H;
    for (int j = 0; j < H; ++j) std::copy_n(sums + at.wm + (l * Hp + j) * Hp, H, wm + j * H);
    std::copy_n(sums + at.bm + l * Hp, H, bm);
  }
  for (int o = 0; o < out; ++o) std::copy_n(sums + at.w2 + int64_t(o) * Hp, H, w2 + int64_t(o) * H);
  std::copy_n(sums + at.b2, out, b2);
}

void write_routers(const Decode& d, const Sizes& s, const Layout& layout, const float* sums) {
  for (int i = 0; i < 3; ++i) {
    const Head& head = d.heads[i];
    if (!head.router_w) continue;
    const int inputs = s.F + (head.position ? 3 : 0);
    for (int e = 0; e < head.E; ++e) {
      const float* from = sums + layout.router + int64_t(s.first[i] + e) * s.routerp;
      for (int c = 0; c < inputs; ++c) head.d_router_w[int64_t(e) * inputs + c] = from[c < s.F ? c : c + 5];
      if (head.d_router_b) head.d_router_b[e] = sums[layout.router_b + s.first[i] + e];
    }
  }
}

// Memory for `floats` floats, kept from call to call: new memory would cost page faults every time.
float* reserve_sums(int64_t floats) {
  static thread_local std::unique_ptr<float[]> memory;
  static thread_local int64_t size = 0;
  if (floats > size) {
    memory.reset();
    size = 0;
    memory.reset(new float[floats]);
    size = floats;
  }
  return memory.get();
}

}  // namespace

SE_EXPORT int32_t se_decode_backward(const Decode* decode) {
  return run_guarded([&] {
    const Decode& d = *decode;
    const Sizes s(d);
    const Packed packed(d, s, true);
    const Layout layout(d, s);
    const int64_t grain = std::max<int64_t>(1, (count_chunks(d) + BUFFERS - 1) / BUFFERS) * CHUNK;
    const int64_t buffers = std::max<int64_t>(1, (d.A + grain - 1) / grain);
    float* sums = reserve_sums(buffers * layout.total);
    if (!d.A) std::fill_n(sums, layout.total, 0.f);
    const int threads = static_cast<int>(d.threads);
    parallel_for(d.A, grain, threads, [&](int64_t begin, int64_t end, int) {
      float* own = sums + begin / grain * layout.total;
      std::fill_n(own, layout.total, 0.f);
      Backward pass(d, s, packed, layout, own);
      for (int64_t at = begin; at < end; at += CHUNK) pass.run(at, std::min<int64_t>(end, at + CHUNK));
    });
    parallel_for(layout.total, 4096, threads, [&](int64_t begin, int64_t end, int) {
      for (int64_t b = 1; b < buffers; ++b)
        for (int64_t i = begin; i < end; ++i) sums[i] += sums[b * layout.total + i];
    });
    for_each_expert(d, [&](int i, int e) { write_expert(d, s, layout.experts[i][e], sums, i, e); });
    write_routers(d, s, layout, sums);
    if (d.steps) std::copy_n(sums + layout.steps, s.F + 6 + 3 * s.K, d.d_log_steps);
  });
}
