// The fused decode of an anchor scene: gather -> direction -> routing -> expert networks -> Gaussians, forward
// and backward.
//
// There are A anchors in view, each with K slots, a feature of F values and the inputs z = (f, direction, 1,
// distance, position). The 1 multiplies the bias of the first layer; the position is an input of routers that
// ask for it. Each of the three heads (opacity, covariance, colour) has E experts W2 relu(.. relu(W1 z)) + b2,
// followed by tanh, identity or sigmoid. Their outputs are mixed with weights: none (one network), all gates
// (dense), or the softmax over the k largest logits (ties go to the lowest index). A head with several experts and no
// router weights is routed outside: the mixture weights are inputs, and their gradients are outputs.
//
// The work is divided into chunks of CHUNK anchors. Within a chunk, the anchors of one expert are gathered, so
// that its weights stay in the L1 cache (products.h). Covariance and colour are computed only for anchors that
// draw something. Gradients of weights are summed in at most BUFFERS partial buffers over fixed ranges of
// chunks, then in a fixed order, which gives the same bits for every number of threads.
//
// With steps, values are rounded where they are gathered: v becomes r((v - o) / s) s + o, s = step times factor. The
// gradient of v is that of the rounded value (straight-through), and the gradient of the logarithm of a step is
// the sum of gradient times (rounded value - v) (Esser et al. 2020).
#pragma once
#include <cstdint>
#include <vector>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"

namespace se {

constexpr int CHUNK = 256;   // anchors per chunk
constexpr int BLOCK = 48;    // anchors per block of one expert
constexpr int BUFFERS = 16;  // partial sums of weight gradients
constexpr int COV = 7;       // 3 scale, 4 rotation

using Head = SeDecodeHead;
using Decode = SeDecode;

inline bool has_one_expert(const Head& h) { return h.E == 1 || (h.k == 1 && h.router_w); }  // one expert of weight 1 per anchor
inline bool mixes_linearly(int i) { return i == 1; }                                        // head i has no activation
inline bool uses_all_experts(const Head& h) { return h.k == 0; }                            // every expert sees every anchor
inline int experts_per_anchor(const Head& h) { return static_cast<int>(h.k ? h.k : h.E); }
inline int64_t count_chunks(const Decode& d) { return (d.A + CHUNK - 1) / CHUNK; }
// Row of gates, chosen and chosen_weight that belongs to `anchor`.
inline int64_t routing_row(const Decode& d, int64_t anchor) { return d.frozen ? d.rows[anchor] : anchor; }

// Sizes of the padded blocks.
struct Sizes {
  int K, F, Fp, Z, R, Rp;                               // slots; feature; one row of z; logits of all heads together
  int router, routerp;                                  // inputs of the routers: F, or z up to the position
  int shares, L, Hp_most;                               // the largest of the three heads
  int H[3], Hp[3], out[3], Op[3], inputs[3], first[3];  // first: offset of the head's logits
  explicit Sizes(const Decode& d);
};

// Call f(head, expert) for every expert, on all threads.
template <class F>
void for_each_expert(const Decode& d, F&& f) {
  const int64_t first = d.heads[0].E, second = first + d.heads[1].E;
  parallel_for(second + d.heads[2].E, 1, static_cast<int>(d.threads), [&](int64_t e, int64_t, int) {
    if (e < first)
      f(0, static_cast<int>(e));
    else if (e < second)
      f(1, static_cast<int>(e - first));
    else
      f(2, static_cast<int>(e - second));
  });
}

// The weights in the layouts that the products read, padded with zeros.
struct Packed {
  struct Expert {
    std::vector<float> w1t, wmt, bm, w2t, b2, w1, wm, w2;  // [inputs][Hp], [L][H][Hp], [L][Hp], [H][Op], [Op]; for the
                                                           // backward pass [H][Fp], [L][H][Hp], [out][Hp]
    Expert() = default;
    Expert(const Decode& d, const Sizes& s, int head, int number, bool backward);
  };
  std::vector<Expert> experts[3];
  std::vector<float> router_t, router_b, router;  // [router][Rp], [Rp]; for the backward pass [R][Fp]
  Packed(const Decode& d, const Sizes& s, bool backward);
};

// Workspace of one chunk: one block of memory that belongs to the thread.
struct Work {
  float* z;                       // [CHUNK][Z]
  float* block;                   // [BLOCK][Z]
  float* hidden;                  // [1 + L + 2][BLOCK][Hp]: activations of each layer, then two gradients
  float* out;                     // [2][BLOCK][Op]
  float* mixed[3];                // [CHUNK][Op]: mixed outputs, or their gradients
  float* logits;                  // [CHUNK][Rp], then 4 times [Rp][CHUNK]
  float* feature;                 // [CHUNK][Fp]: gradient
  float* weights;                 // [CHUNK][shares]: gradient of the mixture weights
  float* size;                    // [CHUNK][8]: exp(l) of offsets, 1, of scales, 1
  float* spread;                  // [CHUNK * K][3]
  float* row;                     // [3 K]: rounded offsets of an anchor
  float* weight;                  // lists: mixture weight, [CHUNK * shares]
  int *anchor, *place;            // lists: index in the chunk; anchor * shares + index of the expert
  uint64_t* bits;                 // one bit per slot of the chunk: it is drawn
  uint8_t* live;                  // [CHUNK]: at least one slot is drawn
  explicit Work(const Sizes& s);  // valid until the thread's next Work
};

// One chunk of anchors.
struct Chunk {
  int64_t begin;  // first anchor
  int n;
};

// One expert's part of a chunk: entries first .. first + n - 1 of the lists.
struct Group {
  int expert, first, n;
};

// Copy or clear a row without access beyond its end.
inline void copy_row(const float* from, int n, float* to) {
  int i = 0;
  for (; i + LANES <= n; i += LANES) store(to + i, load(from + i));
  if (i < n) store_part(to + i, load_part(from + i, n - i), n - i);
}
inline void zero_row(float* to, int n) {
  int i = 0;
  for (; i + LANES <= n; i += LANES) store(to + i, broadcast(0.f));
  if (i < n) store_part(to + i, broadcast(0.f), n - i);
}

// Up to 32 slots of an anchor, from `slot` on, that are drawn: bit j is slot + j.
inline uint32_t drawn_slots(const Work& w, int K, int anchor, int slot) {
  const int at = anchor * K + slot, n = K - slot < 32 ? K - slot : 32;
  const uint64_t low = w.bits[at >> 6] >> (at & 63), high = (w.bits[(at >> 6) + 1] << 1) << (63 - (at & 63));
  return static_cast<uint32_t>((low | high) & ((uint64_t(1) << n) - 1));
}
template <class F>
inline void for_each_drawn(const Work& w, int K, int anchor, F&& f) {
  for (int slot = 0; slot < K; slot += 32)
    for (uint32_t bits = drawn_slots(w, K, anchor, slot); bits; bits &= bits - 1) f(slot + __builtin_ctz(bits));
}

// Round n values to origin plus multiples of steps times factor.
void round_row(const float* from, const float* steps, float factor, float origin, int n, float* to);
// The six log-scalings of a row as they are drawn.
void round_scaling(const Decode& d, int64_t row, float* to);
// Add gradient (rounded - exact) to the gradients of the logarithms of n steps.
void add_step_gradients(const float* gradient, const float* rounded, const float* exact, int n, float* to);
// The offsets [3 K] of a row as they are drawn.
const float* find_offsets(const Decode& d, int64_t row, Work& w);
void gather(const Decode& d, const Sizes& s, const Chunk& chunk, Work& w);
void find_drawn(const Decode& d, const Chunk& chunk, Work& w);  // fill bits and live from raw and slots
void compute_sizes(const Decode& d, const Chunk& chunk, Work& w);
// Group the anchors of the chunk by expert; with `live_only`, only those that draw something.
void group_by_expert(const Decode& d, const Head& head, const Chunk& chunk, bool live_only, Work& w, std::vector<Group>& found);
void copy_block_inputs(const Work& w, const Sizes& s, const Group& g, int from, int n);
// Compute the hidden layers of w.block and return the last one.
float* compute_hidden(const Packed::Expert& e, const Sizes& s, int head, int middle, int n, Work& w);
void compute_outputs(const Packed::Expert& e, const Sizes& s, int head, int n, const float* h, float* y);
void activate(int head, float* y, int n);
inline int block_size(int n) {  // equal parts of at most BLOCK
  const int parts = (n + BLOCK - 1) / BLOCK;
  return parts ? (n + parts - 1) / parts : 1;
}

void route(const Decode& d, const Sizes& s, const Packed& packed, const Chunk& chunk, Work& w);
// From the gradients of the mixture weights (w.weights) and of the gates to those of the logits.
void differentiate_routing(const Decode& d, const Sizes& s, const Chunk& chunk, int head, Work& w);
// Write the Gaussians of a chunk from its mixed outputs; and the gradients of the outputs from those of the
// Gaussians.
void emit_gaussians(const Decode& d, const Sizes& s, const Chunk& chunk, int64_t first, Work& w);
// step_sums: [F + 6 + 3 K], where the gradients of steps are added; unused without steps.
void differentiate_gaussians(const Decode& d, const Sizes& s, const Chunk& chunk, Work& w, float* step_sums);

}  // namespace se
