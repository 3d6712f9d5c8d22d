// Gates, chosen experts and their mixture weights, and their gradients. See decode.h.
#include <algorithm>
#include <cmath>
#include <limits>

#include "decode.h"
#include "products.h"

namespace se {
namespace {

// Softmax over `count` rows of CHUNK lanes, in place.
void softmax(float* rows, int count, int n) {
  for (int a = 0; a < n; a += LANES) {
    Vec largest = load(rows + a), total = broadcast(0.f);
    for (int e = 1; e < count; ++e) largest = max(largest, load(rows + e * CHUNK + a));
    for (int e = 0; e < count; ++e) {
      const Vec x = exponential(load(rows + e * CHUNK + a) - largest);
      store(rows + e * CHUNK + a, x);
      total = total + x;
    }
    const Vec inverse = broadcast(1.f) / total;
    for (int e = 0; e < count; ++e) store(rows + e * CHUNK + a, load(rows + e * CHUNK + a) * inverse);
  }
}

// Find the k largest of E rows of logits: their values and their indices (as floats), largest first. Ties go to
// the lowest index. Overwrites `logits`.
void choose(float* logits, int E, int k, int n, float* values, float* places) {
  for (int a = 0; a < n; a += LANES)
    for (int r = 0; r < k; ++r) {
      Vec best = load(logits + a), place = broadcast(0.f);
      for (int e = 1; e < E; ++e) {
        const Vec x = load(logits + e * CHUNK + a);
        place = select_greater(x, best, broadcast(float(e)), place);
        best = select_greater(x, best, x, best);
      }
      store(values + r * CHUNK + a, best);
      store(places + r * CHUNK + a, place);
      const Vec gone = broadcast(-std::numeric_limits<float>::infinity());
      for (int e = 0; e < E; ++e) {
        const Vec x = load(logits + e * CHUNK + a);
        store(logits + e * CHUNK + a, select_greater(place, broadcast(e - 0.5f), select_greater(broadcast(e + 0.5f), place, gone, x), x));
      }
    }
}

}  // namespace

void route(const Decode& d, const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w) {
  if (!s.R) return;
  float* across = w.logits + int64_t(CHUNK + SLACK) * s.Rp;  // [R][CHUNK], transposed: anchors along the lanes
  multiply(chunk.n, s.Rp, s.router, w.z, s.Z, packed.router_t.data(), s.Rp, packed.router_b.data(), Store{w.logits, s.Rp});
  for (int r = 0; r < s.R; ++r)
    for (int a = 0; a < chunk.n; ++a) across[r * CHUNK + a] = w.logits[a * s.Rp + r];
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
    float* mix = head.chosen_weight + chunk.begin * k;
    for (int a = 0; a < n; ++a)
      for (int r = 0; r < k; ++r) {
        chosen[a * k + r] = static_cast<int64_t>(places[r * CHUNK + a]);
        mix[a * k + r] = values[r * CHUNK + a];
      }
  }
}

void differentiate_routing(const Decode& d, const Sizes& s, const Chunk& chunk, int i, Work& w) {
  const Head& head = d.heads[i];
  const int E = static_cast<int>(head.E), k = static_cast<int>(head.k), shares = experts_per_anchor(head);
  const bool dense = k == 0 && E > 1;
  for (int a = 0; a < chunk.n; ++a) {
    const int64_t anchor = chunk.begin + a;
    float* to = w.logits + int64_t(a) * s.Rp + s.first[i];  // no other worker writes here
    const float* own = w.weights + int64_t(a) * shares;
    const float *gates = head.gates + anchor * E, *direct = head.d_gates ? head.d_gates + anchor * E : nullptr;
    const float* mix = head.chosen_weight + anchor * k;
    const int64_t* chosen = head.chosen + anchor * k;
    float mean = 0;
    if (dense || direct) {
      for (int e = 0; e < E; ++e) to[e] = (direct ? direct[e] : 0.f) + (dense ? own[e] : 0.f);
      for (int e = 0; e < E; ++e) mean += gates[e] * to[e];
      for (int e = 0; e < E; ++e) to[e] = gates[e] * (to[e] - mean);
    } else {
      for (int e = 0; e < E; ++e) to[e] = 0.f;
    }
    if (k <= 1) continue;
    mean = 0;
    for (int r = 0; r < k; ++r) mean += mix[r] * own[r];
    for (int r = 0; r < k; ++r) to[chosen[r]] += mix[r] * (own[r] - mean);
  }
}

}  // namespace se
