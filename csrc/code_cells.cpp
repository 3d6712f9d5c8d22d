// Cells of compact files: an octree, level by level and node by node along the Morton curve, one bit per child with an adaptive
// probability. The context of a child: its number, what is known across its six faces, and the depth. The slow form is
// src/scene_experts/files/codec/reference.py.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "code.h"
#include "se_api.h"
#include "status.h"

namespace {
using se::kCodeBits;
constexpr int kDepths = 4, kStates = 64;         // deeper levels share the last depth's contexts; states across the faces
constexpr uint32_t kMostSeen = 1023;             // counts are halved beyond it
constexpr uint64_t kAxis = 0x1249249249249249u;  // the bits of x in a key

struct Count {
  uint16_t zeros = 0, ones = 0;
  uint32_t share() const {  // of zeros, in 2^-15
    const uint32_t share = ((2 * zeros + 1u) << kCodeBits) / (2u * (zeros + ones) + 2u);
    return std::clamp<uint32_t>(share, 32, (1u << kCodeBits) - 32);
  }
  void add(bool one) {
    if (one)
      ++ones;
    else
      ++zeros;
    if (zeros + ones > kMostSeen) {
      zeros = (zeros + 1) >> 1;
      ones = (ones + 1) >> 1;
    }
  }
};

// The nodes of one level by key.
class Nodes {
 public:
  explicit Nodes(const std::vector<uint64_t>& keys) {
    int bits = 4;
    while ((size_t{1} << bits) < 2 * keys.size()) ++bits;
    shift_ = 64 - bits;
    mask_ = (size_t{1} << bits) - 1;
    slots_.assign(size_t{1} << bits, -1);
    keys_ = keys.data();
    for (size_t i = 0; i < keys.size(); ++i) {
      size_t at = hash(keys[i]);
      while (slots_[at] >= 0) at = (at + 1) & mask_;
      slots_[at] = static_cast<int32_t>(i);
    }
  }
  int32_t find(uint64_t key) const {  // -1: none
    size_t at = hash(key);
    while (slots_[at] >= 0) {
      if (keys_[slots_[at]] == key) return slots_[at];
      at = (at + 1) & mask_;
    }
    return -1;
  }

 private:
  size_t hash(uint64_t key) const { return (key * 0x9E3779B97F4A7C15u) >> shift_; }
  std::vector<int32_t> slots_;
  const uint64_t* keys_;
  size_t mask_;
  int shift_;
};

// The key one step along an axis; `depth` bits per axis. False at the border of the cube.
inline bool step(uint64_t key, int axis, bool up, int depth, uint64_t* out) {
  const uint64_t bits = (kAxis & ((uint64_t{1} << (3 * depth)) - 1)) << axis, own = key & bits;
  if (own == (up ? bits : 0)) return false;
  const uint64_t moved = up ? ((key | ~bits) + (uint64_t{1} << axis)) & bits : (own - (uint64_t{1} << axis)) & bits;
  *out = (key & ~bits) | moved;
  return true;
}

// Walk the tree. `ask(level, share, node, child)` codes one bit and returns it. False: more than `most` nodes.
template <class Ask>
bool walk(int depth, int64_t most, std::vector<uint64_t>* nodes, Ask&& ask) {
  std::vector<Count> counts(size_t{kDepths} * 8 * kStates);
  nodes->assign(1, 0);
  std::vector<uint8_t> children;
  std::vector<uint64_t> next;
  for (int level = 0; level < depth; ++level) {
    const Nodes known(*nodes);
    const int left = std::min(depth - 1 - level, kDepths - 1);
    children.assign(nodes->size(), 0);
    next.clear();
    for (size_t i = 0; i < nodes->size(); ++i) {
      int32_t beside[3][2];
      for (int a = 0; a < 3; ++a)
        for (int up = 0; up < 2; ++up) {
          uint64_t key;
          beside[a][up] = step((*nodes)[i], a, up, level, &key) ? known.find(key) : -1;
        }
      unsigned own = 0;
      for (int b = 0; b < 8; ++b) {
        bool one = b == 7 && !own;  // a node has a child
        if (!one) {
          int state = 0;
          for (int a = 0; a < 3; ++a) {
            const bool high = b >> a & 1;
            const int32_t node = beside[a][high];
            const int side = high ? 2 * (own >> (b ^ (1 << a)) & 1) + (node >= 0) : node < 0 ? 0 : 1 + (children[node] >> (b ^ (1 << a)) & 1);
            state = 4 * state + side;
          }
          Count& count = counts[(left * 8 + b) * kStates + state];
          one = ask(level, count.share(), i, b);
          count.add(one);
        }
        if (one) {
          own |= 1u << b;
          next.push_back((*nodes)[i] << 3 | b);
        }
      }
      children[i] = static_cast<uint8_t>(own);
      if (static_cast<int64_t>(next.size()) > most) return false;
    }
    nodes->swap(next);
  }
  return true;
}
}  // namespace

SE_EXPORT int64_t se_code_cells(const int64_t* keys, int64_t count, int32_t depth, uint32_t* operations, int64_t capacity) {
  int64_t written = 0;
  const int status = se::run_guarded([&] {
    std::vector<uint64_t> nodes;
    int64_t at = 0;  // the first key that is not before the child
    int last = 0;
    walk(depth, count, &nodes, [&](int level, uint32_t zeros, size_t node, int child) {
      if (level != last) last = level, at = 0;
      const int shift = 3 * (depth - 1 - level);
      const uint64_t key = nodes[node] << 3 | static_cast<uint64_t>(child);
      while (at < count && static_cast<uint64_t>(keys[at]) >> shift < key) ++at;
      const bool one = at < count && static_cast<uint64_t>(keys[at]) >> shift == key;
      if (written < capacity)
        operations[written] = one ? se::code_operation(zeros, (1u << kCodeBits) - zeros) : se::code_operation(0, zeros);
      ++written;
      return one;
    });
  });
  return status ? -1 : written;
}

SE_EXPORT int32_t se_code_read_cells(SeCodeReader* reader, int32_t depth, int64_t count, int64_t* keys) {
  se::CodeInput input(reader->words, reader->count, reader->at, reader->operations, reader->state);
  std::vector<uint64_t> nodes;
  bool whole = false;
  const int status = se::run_guarded([&] {
    whole = walk(depth, count, &nodes, [&](int, uint32_t zeros, size_t, int) { return input.bit(zeros); });
  });
  if (status) return status;
  reader->at = input.at();
  reader->operations = input.operations();
  for (int i = 0; i < se::kCodeLanes; ++i) reader->state[i] = input.state(i);
  if (!whole || input.failed() || static_cast<int64_t>(nodes.size()) != count) return se::kDamaged;
  std::copy(nodes.begin(), nodes.end(), keys);
  return 0;
}
