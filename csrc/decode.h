// The fused decode of an anchor scene: gather -> direction -> routing -> expert networks -> Gaussians, forward and backward.
//
// A anchors are seen, each with K slots, a feature of F values and inputs z = (f, direction, 1, distance): the 1 carries the first layer's
// bias. Three heads (opacity, covariance, colour) have E experts W2 relu(W1 z) + b2, each with its own tanh, identity or sigmoid, mixed
// with weights w: none (one network), all gates (dense), or the softmax over the k largest logits (ties to the lowest index).
//
// Work is cut into CHUNK anchors; within a chunk the anchors of one expert are gathered, so that its weights stay in the first-level cache
// (`products.h`). Gradients of weights are summed in at most BUFFERS partial buffers over fixed ranges of chunks, then in fixed order: the
// same bits for every number of threads.
#pragma once
#include <cstdint>
#include <vector>

#include "lanes.h"

namespace se {

constexpr int CHUNK = 256;   // anchors
constexpr int BLOCK = 48;    // anchors of one expert at a time
constexpr int BUFFERS = 16;  // partial sums of weight gradients
constexpr int COV = 7;       // 3 scale, 4 rotation

// Plain C structures, mirrored by scene/native_decode.py: pointers first, then 64-bit integers.
struct Head {
  const float *router_w, *router_b, *w1, *b1, *w2, *b2;  // [E,F] or null, [E] or null, [E,H,D], [E,H], [E,out,H], [E,out]
  float* gates;                                          // [A,E], with a router
  int64_t* chosen;                                       // [A,k], with a router and k > 0
  float* mix;                                            // [A,k], the weights of the chosen
  float *d_router_w, *d_router_b, *d_w1, *d_b1, *d_w2, *d_b2;
  const float* d_gates;         // [A,E] or null
  int64_t E, k, H, out, distance;  // k = 0: dense; distance: 1 if it is an input
  bool single() const { return E == 1 || k == 1; }  // one expert of weight 1 per anchor
};

struct Decode {
  const int64_t* rows;                                              // [A]
  const float *xyz, *feature, *log_scaling, *offsets, *camera;      // [N,3], [N,F], [N,6], [N,K,3], [3]
  float* raw;                                                       // [A,K]
  int64_t* starts;                                                  // [chunks + 1]: first Gaussian of each chunk
  float *means, *quats, *scales, *opacities, *colors, *per_length;  // [M,...]; per_length = 1 / length of the mixed quaternion
  int64_t* source;                                                  // [M]
  const float *d_means, *d_quats, *d_scales, *d_opacities, *d_colors, *d_raw;  // any may be null
  float *d_feature, *d_log_scaling, *d_offsets;                     // [N,...]
  int64_t A, N, K, F, threads, ascending;                           // ascending: rows are; then the gaps between them are zeroed here
  Head heads[3];                                                    // opacity, covariance, colour
  int64_t chunks() const { return (A + CHUNK - 1) / CHUNK; }
};

// Sizes of padded blocks.
struct Sizes {
  int F, Fp, Z, R, Rp;  // feature; of one row z; logits of all heads together
  int H[3], Hp[3], out[3], Op[3], inputs[3], first[3];  // first: of the head's logits
  explicit Sizes(const Decode& d) : F(static_cast<int>(d.F)), Fp(round_up(F, 16)), Z(round_up(F + 5, 16)), R(0) {
    for (int i = 0; i < 3; ++i) {
      const Head& h = d.heads[i];
      H[i] = static_cast<int>(h.H), Hp[i] = round_up(H[i], 16);
      out[i] = static_cast<int>(h.out), Op[i] = round_up(out[i], 16);
      inputs[i] = F + 4 + static_cast<int>(h.distance);
      first[i] = R;
      if (h.router_w) R += static_cast<int>(h.E);
    }
    Rp = round_up(R, 16);
  }
};

// The weights in the layouts that the products read, padded with zeros.
struct Packed {
  struct Expert {
    std::vector<float> w1t, w2t, b2, w1, w2;  // [inputs][Hp], [H][Op], [Op]; for the backward pass [H][Fp], [out][Hp]
  };
  std::vector<Expert> experts[3];
  std::vector<float> router_t, router_b, router;  // [F][Rp], [Rp]; backward [R][Fp]
  Packed(const Decode& d, const Sizes& s, bool backward);
};

// One chunk of anchors and its blocks in the worker's memory.
struct Chunk {
  int64_t begin;  // first anchor
  int n;
  float* z;       // [n][Z]
};

// What one expert computes at once.
struct Group {
  int expert, n;
  const int *anchor, *slot;  // [n]: index in the chunk; place among the anchor's k (dense: the expert)
};

// The slots of a chunk that are drawn, in order.
struct Drawn {
  int count;
  const int *anchor, *slot;  // [count], anchor within the chunk
};

// Short rows: a loop in place instead of a call of memmove.
inline void copy_row(const float* from, int n, float* to) {
  int i = 0;
  for (; i + LANES <= n; i += LANES) store(to + i, load(from + i));
  for (; i < n; ++i) to[i] = from[i];
}

// A block of at least `floats` floats that belongs to the calling thread and to `use` until the next call with the same `use`.
float* scratch(int use, int64_t floats);
enum Use { USE_Z, USE_BLOCK, USE_LOGITS, USE_MIXED, USE_HIDDEN, USE_OUT, USE_GRADIENT, USE_FEATURE, USE_SCALING, USE_LISTS, USE_DRAWN, USES };

void gather(const Decode& d, const Sizes& s, Chunk& chunk);
Drawn drawn(const Decode& d, const Chunk& chunk);
std::vector<Group> groups(const Head& head, const Chunk& chunk, int* lists);  // lists [2][n * max(1, k or E)]
void block_inputs(const Chunk& chunk, const Sizes& s, const Group& g, int from, int n, float* to);
void hidden(const Packed::Expert& e, const Sizes& s, int head, int n, const float* z, float* h);
void outputs(const Packed::Expert& e, const Sizes& s, int head, int n, const float* h, float* y);
void activate(int head, float* y, int n);
void scaling(const Decode& d, const Chunk& chunk, float* to);  // exp(l), [n][6]
inline int block_size(int n) {  // equal parts of at most BLOCK
  const int parts = (n + BLOCK - 1) / BLOCK;
  return parts ? (n + parts - 1) / parts : 1;
}
inline float weight(const Head& head, int64_t anchor, int slot) {
  if (!head.router_w) return 1.f;
  return head.k ? head.mix[anchor * head.k + slot] : head.gates[anchor * head.E + slot];
}

}  // namespace se
