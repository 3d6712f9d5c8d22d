// Parts of the fused decode that the forward and the backward pass share. See decode.h.
#include <algorithm>
#include <cmath>

#include "decode.h"
#include "products.h"
#include "quad.h"

namespace se {

Sizes::Sizes(const Decode& d) : K(static_cast<int>(d.K)), F(static_cast<int>(d.F)), Fp(round_up(F, 16)), R(0), shares(1), L(0), Hp_most(0) {
  bool position = false;
  for (int i = 0; i < 3; ++i) {
    const Head& h = d.heads[i];
    H[i] = static_cast<int>(h.H), Hp[i] = round_up(H[i], 16);
    out[i] = static_cast<int>(h.out), Op[i] = round_up(out[i], 16);
    inputs[i] = F + 4 + static_cast<int>(h.distance);
    first[i] = R;
    if (h.router_w) R += static_cast<int>(h.E), position |= h.position != 0;
    shares = std::max(shares, experts_per_anchor(h)), L = std::max(L, static_cast<int>(h.L)), Hp_most = std::max(Hp_most, Hp[i]);
  }
  Rp = round_up(R, 16);
  router = position ? F + 8 : F, routerp = round_up(router, 16);
  Z = round_up(F + (position ? 8 : 5), 16);
}

Packed::Expert::Expert(const Decode& d, const Sizes& s, int i, int e, bool backward) {
  const Head& head = d.heads[i];
  const int D = s.F + 3 + static_cast<int>(head.distance), H = s.H[i], Hp = s.Hp[i], out = s.out[i], Op = s.Op[i];
  const int L = static_cast<int>(head.L);
  const float *from_w1 = head.w1 + int64_t(e) * H * D, *from_b1 = head.b1 + int64_t(e) * H;
  const float *from_w2 = head.w2 + int64_t(e) * out * H, *from_b2 = head.b2 + int64_t(e) * out;
  w1t.assign(int64_t(s.inputs[i]) * Hp, 0.f), w2t.assign(int64_t(H) * Op, 0.f), b2.assign(Op, 0.f);
  for (int j = 0; j < H; ++j) {
    for (int c = 0; c < D; ++c) w1t[int64_t(c < s.F + 3 ? c : c + 1) * Hp + j] = from_w1[int64_t(j) * D + c];
    w1t[int64_t(s.F + 3) * Hp + j] = from_b1[j];
    for (int o = 0; o < out; ++o) w2t[int64_t(j) * Op + o] = from_w2[int64_t(o) * H + j];
  }
  std::copy_n(from_b2, out, b2.begin());
  wmt.assign(int64_t(L) * H * Hp, 0.f), bm.assign(int64_t(L) * Hp, 0.f);
  if (backward) w1.assign(int64_t(H) * s.Fp, 0.f), wm.assign(int64_t(L) * H * Hp, 0.f), w2.assign(int64_t(out) * Hp, 0.f);
  for (int l = 0; l < L; ++l) {
    const float *from_wm = head.middle_w + (int64_t(e) * L + l) * H * H, *from_bm = head.middle_b + (int64_t(e) * L + l) * H;
    std::copy_n(from_bm, H, &bm[int64_t(l) * Hp]);
    for (int j = 0; j < H; ++j)
      for (int c = 0; c < H; ++c) {
        wmt[(int64_t(l) * H + c) * Hp + j] = from_wm[j * H + c];
        if (backward) wm[(int64_t(l) * H + j) * Hp + c] = from_wm[j * H + c];
      }
  }
  if (!backward) return;
  for (int j = 0; j < H; ++j) std::copy_n(from_w1 + int64_t(j) * D, s.F, &w1[int64_t(j) * s.Fp]);
  for (int o = 0; o < out; ++o) std::copy_n(from_w2 + int64_t(o) * H, H, &w2[int64_t(o) * Hp]);
}

Packed::Packed(const Decode& d, const Sizes& s, bool backward) {
  for (int i = 0; i < 3; ++i) experts[i].resize(d.heads[i].E);
  for_each_expert(d, [&](int i, int e) { experts[i][e] = Expert(d, s, i, e, backward); });
  router_t.assign(int64_t(s.router) * s.Rp, 0.f), router_b.assign(s.Rp, 0.f), router.assign(int64_t(s.R) * s.Fp, 0.f);
  for (int i = 0; i < 3; ++i) {
    const Head& head = d.heads[i];
    if (!head.router_w) continue;
    const int inputs = s.F + (head.position ? 3 : 0);
    for (int e = 0; e < head.E; ++e) {
      const int r = s.first[i] + e;
      const float* w = head.router_w + int64_t(e) * inputs;
      for (int c = 0; c < inputs; ++c) router_t[int64_t(c < s.F ? c : c + 5) * s.Rp + r] = w[c];
      std::copy_n(w, s.F, &router[int64_t(r) * s.Fp]);
      router_b[r] = head.router_b ? head.router_b[e] : 0.f;
    }
  }
}

namespace {

std::vector<float>& thread_memory() {
  static thread_local std::vector<float> block;
  return block;
}

}  // namespace

Work::Work(const Sizes& s) {
  const int64_t rows = CHUNK + SLACK, block_rows = BLOCK + SLACK;
  const int Op = std::max({s.Op[0], s.Op[1], s.Op[2]});
  int64_t total = 0;
  const auto take = [&](int64_t floats) {
    const int64_t at = total;
    total += (floats + 15) / 16 * 16;  // whole cache lines
    return at;
  };
  const int64_t parts[] = {take(rows * s.Z),
                           take(block_rows * s.Z),
                           take((s.L + 3) * block_rows * s.Hp_most),
                           take(2 * block_rows * Op),
                           take(rows * s.Op[0]),
                           take(rows * s.Op[1]),
                           take(rows * s.Op[2]),
                           take(rows * s.Rp + 4 * int64_t(s.Rp) * CHUNK),
                           take(rows * s.Fp),
                           take(int64_t(CHUNK) * s.shares + LANES),
                           take(8 * CHUNK),
                           take(3 * int64_t(CHUNK) * s.K + LANES),
                           take(3 * s.K),
                           take(int64_t(CHUNK) * s.shares),
                           take(int64_t(CHUNK) * s.shares),
                           take(int64_t(CHUNK) * s.shares),
                           take(2 * (int64_t(CHUNK) * s.K / 64 + 2)),
                           take(CHUNK)};
  std::vector<float>& own = thread_memory();
  if (static_cast<int64_t>(own.size()) < total + 16) own.resize(total + 16);
  float* base = own.data() + (64 - reinterpret_cast<uintptr_t>(own.data()) % 64) % 64 / sizeof(float);
  z = base + parts[0], block = base + parts[1], hidden = base + parts[2], out = base + parts[3];
  for (int i = 0; i < 3; ++i) mixed[i] = base + parts[4 + i];
  logits = base + parts[7], feature = base + parts[8], weights = base + parts[9], size = base + parts[10];
  spread = base + parts[11], row = base + parts[12], weight = base + parts[13];
  anchor = reinterpret_cast<int*>(base + parts[14]), place = reinterpret_cast<int*>(base + parts[15]);
  bits = reinterpret_cast<uint64_t*>(base + parts[16]), live = reinterpret_cast<uint8_t*>(base + parts[17]);
}

void round_row(const float* from, const float* steps, float factor, float origin, int n, float* to) {
  const Vec scale = broadcast(factor), start = broadcast(origin);
  for (int i = 0; i < n; i += LANES) {
    const int m = std::min(LANES, n - i);
    const bool whole = m == LANES;
    const Vec step = (whole ? load(steps + i) : load_part(steps + i, m)) * scale, v = whole ? load(from + i) : load_part(from + i, m);
    const Vec rounded = round_to_nearest((v - start) / step) * step + start;
    whole ? store(to + i, rounded) : store_part(to + i, rounded, m);
  }
}

void round_scaling(const Decode& d, int64_t row, float* to) {
  round_row(d.log_scaling + row * 6, d.steps + d.F, d.factors[row], static_cast<float>(d.origin), 6, to);
}

void add_step_gradients(const float* gradient, const float* rounded, const float* exact, int n, float* to) {
  for (int i = 0; i < n; ++i) to[i] += gradient[i] * (rounded[i] - exact[i]);
}

const float* find_offsets(const Decode& d, int64_t row, Work& w) {
  const float* exact = d.offsets + row * d.K * 3;
  if (!d.steps) return exact;
  round_row(exact, d.steps + d.F + 6, d.factors[row], 0.f, static_cast<int>(3 * d.K), w.row);
  return w.row;
}

void gather(const Decode& d, const Sizes& s, const Chunk& chunk, Work& w) {
  const F32x4 camera = load3(d.camera);
  const float extent = static_cast<float>(d.extent);
  constexpr int AHEAD = 12;
  for (int a = 0; a < chunk.n; ++a) {
    const int64_t row = d.rows[chunk.begin + a], next = d.rows[chunk.begin + std::min(a + AHEAD, chunk.n - 1)];
    for (int c = 0; c < s.F; c += 16) __builtin_prefetch(d.feature + next * s.F + c);
    __builtin_prefetch(d.xyz + next * 3);
    float* z = w.z + int64_t(a) * s.Z;
    if (d.steps)
      round_row(d.feature + row * s.F, d.steps, d.factors[row], 0.f, s.F, z);
    else
      copy_row(d.feature + row * s.F, s.F, z);
    const F32x4 x = load3(d.xyz + row * 3), v = x - camera;
    const float distance = std::sqrt(dot(v, v));
    F32x4 direction = v * broadcast4(1.f / std::max(distance, 1e-12f));
    direction[3] = 1.f;
    store4(z + s.F, direction);
    z[s.F + 4] = distance;
    if (s.router > s.F) store3(z + s.F + 5, F32x4{x[0] / extent, x[1] / extent, x[2] / extent, 0.f});
  }
}

void find_drawn(const Decode& d, const Chunk& chunk, Work& w) {
  const int K = static_cast<int>(d.K), count = chunk.n * K;
  const float* raw = d.raw + chunk.begin * K;
  std::fill_n(w.bits, count / 64 + 2, 0);
  int i = 0;
  for (; i + LANES <= count; i += LANES) w.bits[i >> 6] |= static_cast<uint64_t>(find_positive(load(raw + i))) << (i & 63);
  if (i < count) w.bits[i >> 6] |= static_cast<uint64_t>(find_positive(load_part(raw + i, count - i))) << (i & 63);
  for (int a = 0; d.slots && a < chunk.n; ++a) {
    const uint8_t* open = d.slots + d.rows[chunk.begin + a] * K;
    for (int slot = 0; slot < K; ++slot) w.bits[(a * K + slot) >> 6] &= ~(static_cast<uint64_t>(!open[slot]) << ((a * K + slot) & 63));
  }
  for (int a = 0; a < chunk.n; ++a) {
    uint32_t any = 0;
    for (int slot = 0; slot < K; slot += 32) any |= drawn_slots(w, K, a, slot);
    w.live[a] = any != 0;
  }
}

void compute_sizes(const Decode& d, const Chunk& chunk, Work& w) {
  for (int a = 0; a < chunk.n; ++a) {
    const float* l = d.log_scaling + d.rows[chunk.begin + a] * 6;
    float rounded[6];
    if (d.steps) {
      round_scaling(d, d.rows[chunk.begin + a], rounded);
      l = rounded;
    }
    store4(w.size + 8 * a, load3(l));
    store4(w.size + 8 * a + 4, load3(l + 3));
  }
  const int n = round_up(8 * chunk.n, LANES);
  for (int i = 0; i < n; i += LANES) store(w.size + i, exponential(load(w.size + i)));
}

void group_by_expert(const Decode& d, const Head& head, const Chunk& chunk, bool live_only, Work& w, std::vector<Group>& found) {
  found.clear();
  const int n = chunk.n, E = static_cast<int>(head.E), k = static_cast<int>(head.k);
  if (uses_all_experts(head)) {
    int live = 0;
    for (int a = 0; a < n; ++a) {
      w.anchor[live] = a;
      live += !live_only || w.live[a];
    }
    for (int e = 0; e < E; ++e) {
      int *anchor = w.anchor + e * live, *place = w.place + e * live;
      float* weight = w.weight + e * live;
      if (e) std::copy_n(w.anchor, live, anchor);
      for (int i = 0; i < live; ++i) {
        place[i] = anchor[i] * E + e;
        weight[i] = E > 1 ? head.gates[routing_row(d, chunk.begin + anchor[i]) * E + e] : 1.f;
      }
      if (live) found.push_back({e, e * live, live});
    }
    return;
  }
  constexpr int FEW = 64;
  int few[FEW] = {};
  std::vector<int> many(E > FEW ? E : 0, 0);
  int* next = E > FEW ? many.data() : few;
  for (int a = 0; a < n; ++a) {
    const int64_t* chosen = head.chosen + routing_row(d, chunk.begin + a) * k;
    if (!live_only || w.live[a])
      for (int r = 0; r < k; ++r) ++next[chosen[r]];
  }
  for (int e = 0, total = 0; e < E; ++e) {
    const int count = next[e];
    if (count) found.push_back({e, total, count});
    next[e] = total;
    total += count;
  }
  for (int a = 0; a < n; ++a) {
    const int64_t at = routing_row(d, chunk.begin + a) * k;
    if (!live_only || w.live[a])
      for (int r = 0; r < k; ++r) {
        const int to = next[head.chosen[at + r]]++;
        w.anchor[to] = a, w.place[to] = a * k + r, w.weight[to] = head.chosen_weight[at + r];
      }
  }
}

void copy_block_inputs(const Work& w, const Sizes& s, const Group& g, int from, int n) {
  const int* anchor = w.anchor + g.first + from;
  for (int i = 0; i < n; ++i) {
    const float* z = w.z + int64_t(anchor[i]) * s.Z;
    float* to = w.block + int64_t(i) * s.Z;
    for (int c = 0; c < s.Z; c += LANES) store(to + c, load(z + c));
  }
}

float* compute_hidden(const Packed::Expert& e, const Sizes& s, int head, int middle, int n, Work& w) {
  const int Hp = s.Hp[head], H = s.H[head];
  multiply(n, Hp, s.inputs[head], w.block, s.Z, e.w1t.data(), Hp, nullptr, StoreRelu{w.hidden, Hp});
  const int64_t layer = int64_t(BLOCK + SLACK) * Hp;
  float* h = w.hidden;
  for (int l = 0; l < middle; ++l, h += layer)
    multiply(n, Hp, H, h, Hp, e.wmt.data() + int64_t(l) * H * Hp, Hp, e.bm.data() + int64_t(l) * Hp, StoreRelu{h + layer, Hp});
  return h;
}

void compute_outputs(const Packed::Expert& e, const Sizes& s, int head, int n, const float* h, float* y) {
  multiply(n, s.Op[head], s.H[head], h, s.Hp[head], e.w2t.data(), s.Op[head], e.b2.data(), Store{y, s.Op[head]});
}

void activate(int head, float* y, int n) {
  if (head == 0)
    for (int i = 0; i < n; i += LANES) store(y + i, tanh(load(y + i)));
  if (head == 2)
    for (int i = 0; i < n; i += LANES) store(y + i, sigmoid(load(y + i)));
}

}  // namespace se
