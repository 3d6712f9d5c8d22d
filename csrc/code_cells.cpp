// Cells of compact files: an octree, level by level and node by node along the Morton curve, one bit per child with an adaptive
// probability. The context of a child: its number, what is known across its six faces, and the depth. The slow form is
// src/scene_experts/files/codec/reference.py.
#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "code.h"
#include "se_api.h"
#include "status.h"

namespace {
using se::kCodeBits;
constexpr int kDepths = 4, kStates = 64;         // deeper levels share the last depth's contexts; states across the faces
constexpr uint32_t kMostSeen = 1023;             // counts are halved beyond it

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

// The nodes of one level, and where their children begin on the next one.
struct Nodes {
  std::vector<uint64_t> keys;
  std::vector<int32_t> beside;     // [n, 3, 2]: the nodes across the faces, -1: none
  std::vector<uint8_t> children;   // masks
  std::vector<int32_t> first;

  int32_t child(int32_t node, int which) const {  // its number on the next level, -1: none
    if (node < 0 || !(children[node] >> which & 1)) return -1;
    return first[node] + __builtin_popcount(children[node] & ((1u << which) - 1));
  }
};

// What is known across the faces of the eight children of a node, a byte each: a state below kStates, made of x, y, z in turn by
// `state = 4 state + side`. Every table is added to it.
struct Sides {
  uint64_t below[3][257];  // by the children of the node across the low face, 256: none
  uint64_t above[3];       // where there is a node across the high face
  uint64_t own[8];         // once a child is there
};
const Sides& sides() {
  static const Sides tables = [] {
    Sides out{};
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b < 8; ++b) {
        const int other = b ^ 1 << a;
        const uint64_t unit = uint64_t{1} << (8 * b + 2 * (2 - a));
        if (b >> a & 1) {
          out.above[a] += unit;
          out.own[other] += 2 * unit;
        } else {
          for (int children = 0; children < 256; ++children) out.below[a][children] += (1 + (children >> other & 1)) * unit;
        }
      }
    return out;
  }();
  return tables;
}

// Walk the tree. `ask(level, share, key of the child)` codes one bit and returns it. False: more than `most` nodes, or `has_failed()`.
template <class Ask, class Failed>
bool walk(int depth, int64_t most, std::vector<uint64_t>* leaves, Ask&& ask, Failed&& has_failed) {
  const Sides& known = sides();
  std::vector<Count> counts(size_t{kDepths} * 8 * kStates);
  Nodes now, next;
  now.keys.assign(1, 0);
  now.beside.assign(6, -1);
  for (int level = 0; level < depth; ++level) {
    const int left = std::min(depth - 1 - level, kDepths - 1);
    const size_t n = now.keys.size();
    now.children.assign(n, 0);
    now.first.resize(n);
    next.keys.clear();
    for (size_t i = 0; i < n; ++i) {
      const int32_t* beside = now.beside.data() + 6 * i;
      now.first[i] = static_cast<int32_t>(next.keys.size());
      uint64_t states = 0;
      for (int a = 0; a < 3; ++a) {
        states += known.below[a][beside[2 * a] < 0 ? 256 : now.children[beside[2 * a]]];
        states += beside[2 * a + 1] < 0 ? 0 : known.above[a];
      }
      unsigned own = 0;
      for (int b = 0; b < 8; ++b) {
        bool one = b == 7 && !own;  // a node has a child
        if (!one) {
          Count& count = counts[(left * 8 + b) * kStates + (states >> 8 * b & 0xFF)];
          one = ask(level, count.share(), now.keys[i] << 3 | b);
          count.add(one);
        }
        if (one) {
          own |= 1u << b;
          states += known.own[b];
          next.keys.push_back(now.keys[i] << 3 | b);
        }
      }
      now.children[i] = static_cast<uint8_t>(own);
      if (static_cast<int64_t>(next.keys.size()) > most || has_failed()) return false;
    }
    if (level + 1 < depth) {
      next.beside.resize(6 * next.keys.size());
      int32_t* out = next.beside.data();
      for (size_t i = 0; i < n; ++i)
        for (int b = 0; b < 8; ++b)
          if (now.children[i] >> b & 1)
            for (int a = 0; a < 3; ++a)
              for (int up = 0; up < 2; ++up) {
                const bool inside = (b >> a & 1) != up;
                *out++ = now.child(inside ? static_cast<int32_t>(i) : now.beside[6 * i + 2 * a + up], b ^ 1 << a);
              }
    }
    std::swap(now, next);
  }
  leaves->swap(now.keys);
  return true;
}
}  // namespace

SE_EXPORT int64_t se_code_cells(const int64_t* keys, int64_t count, int32_t depth, uint32_t* operations, int64_t capacity) {
  int64_t written = 0;
  const int status = se::run_guarded([&] {
    std::vector<uint64_t> leaves;
    int64_t at = 0;  // the first key that is not before the child
    int last = 0;
    const auto ask = [&](int level, uint32_t zeros, uint64_t key) {
      if (level != last) last = level, at = 0;
      const int shift = 3 * (depth - 1 - level);
      while (at < count && static_cast<uint64_t>(keys[at]) >> shift < key) ++at;
      const bool one = at < count && static_cast<uint64_t>(keys[at]) >> shift == key;
      if (written < capacity)
        operations[written] = one ? se::code_operation(zeros, (1u << kCodeBits) - zeros) : se::code_operation(0, zeros);
      ++written;
      return one;
    };
    walk(depth, count, &leaves, ask, [] { return false; });
  });
  return status ? -1 : written;
}

SE_EXPORT int32_t se_code_read_cells(SeCodeReader* reader, int32_t depth, int64_t count, int64_t* keys) {
  se::CodeInput input(reader->words, reader->count, reader->at, reader->operations, reader->state);
  std::vector<uint64_t> leaves;
  bool whole = false;
  const int status = se::run_guarded([&] {
    const auto ask = [&](int, uint32_t zeros, uint64_t) { return input.bit(zeros); };
    whole = walk(depth, count, &leaves, ask, [&] { return input.failed(); });
  });
  if (status) return status;
  reader->at = input.at();
  reader->operations = input.operations();
  for (int i = 0; i < se::kCodeLanes; ++i) reader->state[i] = input.state(i);
  if (!whole || input.failed() || static_cast<int64_t>(leaves.size()) != count) return se::kDamaged;
  std::copy(leaves.begin(), leaves.end(), keys);
  return 0;
}
