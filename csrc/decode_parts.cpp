// The parts of the fused decode that its forward and backward pass share. See decode.h.
#include <algorithm>
#include <cmath>

#include "decode.h"
#include "products.h"

namespace se {

Packed::Packed(const Decode& d, const Sizes& s, bool backward) {
  for (int i = 0; i < 3; ++i) {
    const Head& head = d.heads[i];
    const int D = s.F + 3 + static_cast<int>(head.distance), H = s.H[i], Hp = s.Hp[i], out = s.out[i], Op = s.Op[i];
    experts[i].resize(head.E);
    for (int e = 0; e < head.E; ++e) {
      const float *w1 = head.w1 + int64_t(e) * H * D, *b1 = head.b1 + int64_t(e) * H;
      const float *w2 = head.w2 + int64_t(e) * out * H, *b2 = head.b2 + int64_t(e) * out;
      Expert& x = experts[i][e];
      x.w1t.assign(int64_t(s.inputs[i]) * Hp, 0.f), x.w2t.assign(int64_t(H) * Op, 0.f), x.b2.assign(Op, 0.f);
      for (int j = 0; j < H; ++j) {
        for (int c = 0; c < D; ++c) x.w1t[int64_t(c < s.F + 3 ? c : c + 1) * Hp + j] = w1[int64_t(j) * D + c];
        x.w1t[int64_t(s.F + 3) * Hp + j] = b1[j];
        for (int o = 0; o < out; ++o) x.w2t[int64_t(j) * Op + o] = w2[int64_t(o) * H + j];
      }
      std::copy_n(b2, out, x.b2.begin());
      if (!backward) continue;
      x.w1.assign(int64_t(H) * s.Fp, 0.f), x.w2.assign(int64_t(out) * Hp, 0.f);
      for (int j = 0; j < H; ++j) std::copy_n(w1 + int64_t(j) * D, s.F, &x.w1[int64_t(j) * s.Fp]);
      for (int o = 0; o < out; ++o) std::copy_n(w2 + int64_t(o) * H, H, &x.w2[int64_t(o) * Hp]);
    }
  }
  router_t.assign(int64_t(s.F) * s.Rp, 0.f), router_b.assign(s.Rp, 0.f), router.assign(int64_t(s.R) * s.Fp, 0.f);
  for (int i = 0; i < 3; ++i) {
    const Head& head = d.heads[i];
    if (!head.router_w) continue;
    for (int e = 0; e < head.E; ++e) {
      const int r = s.first[i] + e;
      for (int c = 0; c < s.F; ++c) router_t[int64_t(c) * s.Rp + r] = router[int64_t(r) * s.Fp + c] = head.router_w[int64_t(e) * s.F + c];
      router_b[r] = head.router_b ? head.router_b[e] : 0.f;
    }
  }
}

float* scratch(int use, int64_t floats) {
  static thread_local std::vector<float> blocks[USES];
  std::vector<float>& block = blocks[use];
  if (static_cast<int64_t>(block.size()) < floats) block.resize(floats);
  return block.data();
}

void gather(const Decode& d, const Sizes& s, Chunk& chunk) {
  chunk.z = scratch(USE_Z, int64_t(CHUNK + SLACK) * s.Z);
  for (int a = 0; a < chunk.n; ++a) {
    const int64_t row = d.rows[chunk.begin + a];
    float* z = chunk.z + int64_t(a) * s.Z;
    const float *f = d.feature + row * s.F, *x = d.xyz + row * 3;
    copy_row(f, s.F, z);
    const float v[3] = {x[0] - d.camera[0], x[1] - d.camera[1], x[2] - d.camera[2]};
    const float distance = std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), inverse = 1.f / std::max(distance, 1e-12f);
    for (int c = 0; c < 3; ++c) z[s.F + c] = v[c] * inverse;
    z[s.F + 3] = 1.f;
    z[s.F + 4] = distance;
  }
}

Drawn drawn(const Decode& d, const Chunk& chunk) {
  const int K = static_cast<int>(d.K), room = chunk.n * K + 1;
  int* anchor = reinterpret_cast<int*>(scratch(USE_DRAWN, 2 * int64_t(room)));
  int *slot = anchor + room, count = 0;
  const float* raw = d.raw + chunk.begin * K;
  for (int a = 0; a < chunk.n; ++a)
    for (int k = 0; k < K; ++k) {  // no branch: which slots are drawn is as good as random
      anchor[count] = a, slot[count] = k;
      count += raw[a * K + k] > 0.f;
    }
  return {count, anchor, slot};
}

std::vector<Group> groups(const Head& head, const Chunk& chunk, int* lists) {
  std::vector<Group> found;
  const int n = chunk.n, E = static_cast<int>(head.E), k = static_cast<int>(head.k);
  if (!head.router_w || k == 0) {  // every expert sees every anchor
    for (int a = 0; a < n; ++a) lists[a] = a;
    for (int e = 0; e < E; ++e) {
      int* slot = lists + n * (1 + e);
      std::fill_n(slot, n, e);
      found.push_back({e, n, lists, slot});
    }
    return found;
  }
  const int64_t* chosen = head.chosen + chunk.begin * k;
  std::vector<int> place(E + 1, 0);
  for (int i = 0; i < n * k; ++i) ++place[chosen[i] + 1];
  for (int e = 0; e < E; ++e) {
    if (place[e + 1]) found.push_back({e, place[e + 1], lists + place[e], lists + n * k + place[e]});
    place[e + 1] += place[e];
  }
  for (int a = 0; a < n; ++a)
    for (int slot = 0; slot < k; ++slot) {
      const int to = place[chosen[a * k + slot]]++;
      lists[to] = a, lists[n * k + to] = slot;
    }
  return found;
}

void block_inputs(const Chunk& chunk, const Sizes& s, const Group& g, int from, int n, float* to) {
  for (int i = 0; i < n; ++i) {
    const float* z = chunk.z + int64_t(g.anchor[from + i]) * s.Z;
    for (int c = 0; c < s.Z; c += LANES) store(to + int64_t(i) * s.Z + c, load(z + c));
  }
}

void hidden(const Packed::Expert& e, const Sizes& s, int head, int n, const float* z, float* h) {
  const int Hp = s.Hp[head];
  product(n, Hp, s.inputs[head], z, s.Z, e.w1t.data(), Hp, nullptr, h, Hp);
  for (int i = 0; i < n * Hp; i += LANES) store(h + i, max(all(0.f), load(h + i)));  // in this order NaN stays NaN
}

void outputs(const Packed::Expert& e, const Sizes& s, int head, int n, const float* h, float* y) {
  product(n, s.Op[head], s.H[head], h, s.Hp[head], e.w2t.data(), s.Op[head], e.b2.data(), y, s.Op[head]);
}

void activate(int head, float* y, int n) {
  if (head == 0)
    for (int i = 0; i < n; i += LANES) store(y + i, tangent(load(y + i)));
  if (head == 2)
    for (int i = 0; i < n; i += LANES) store(y + i, sigmoid(load(y + i)));
}

void scaling(const Decode& d, const Chunk& chunk, float* to) {
  for (int a = 0; a < chunk.n; ++a)
    for (int j = 0; j < 6; ++j) to[6 * a + j] = d.log_scaling[d.rows[chunk.begin + a] * 6 + j];
  for (int i = 0; i < 6 * chunk.n; i += LANES) store(to + i, exponential(load(to + i)));
}

}  // namespace se
