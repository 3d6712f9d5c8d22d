// The integer entropy coder of compact files (docs/compact-file.md): rANS with four states of 32 bits and words of 16 bits.
// Everything here is integer arithmetic, so that every implementation of the format gives the same numbers.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

namespace se {

constexpr int kCodeBits = 15;                          // probabilities are multiples of 2^-15
constexpr int kCodeLanes = 4;                          // states; operation i uses state i mod 4
constexpr int kCodeHalf = 40;                          // symbols -40 .. 40 have entries of their own
constexpr int kCodeSymbols = 2 * kCodeHalf + 2;        // and the escape
constexpr int kCodeScales = 48, kCodePhases = 8;       // tables
constexpr int kCodeTopScale = 127, kCodeTopOdds = 127;  // largest indices
constexpr int32_t kCodeFarthest = 1 << 28;             // means are clamped to +- this
constexpr uint32_t kCodeFloor = 1u << 16;              // least state
constexpr int kDamaged = 2;                            // status: the bytes fit no symbols

struct CodeTables {
  uint16_t below[kCodeScales * kCodePhases][kCodeSymbols + 1];  // cumulative frequencies, the last one 2^15
  uint8_t start[kCodeScales * kCodePhases][128];                // a symbol at or before the one of each share of 2^8
  uint16_t zeros[kCodeTopOdds + 1];                             // frequency of bit 0
};
const CodeTables& code_tables();

// Where a symbol lies: its table, its centre, and how many low bits are stored as they are. A wide scale has low bits, and no phase.
struct CodePlace {
  int32_t table, centre, low;
};
inline CodePlace find_place(int32_t mean, int32_t scale) {
  const int32_t m = std::clamp(mean, -kCodeFarthest, kCodeFarthest), s = std::clamp(scale, 0, kCodeTopScale), centre = (m + 4) >> 3;
  const int32_t low = s < kCodeScales ? 0 : ((s - kCodeScales) >> 3) + 1;
  return {(s - 8 * low) * kCodePhases + (low ? 4 : m - 8 * centre + 4), centre, low};
}

// One step of the coder: a share [start, start + width) of 2^15.
inline uint32_t code_operation(uint32_t start, uint32_t width) { return start << 16 | width; }

// Reads shares from words, at least one. `failed` where they end too early; what is read from there on means nothing.
class CodeInput {
 public:
  CodeInput(const uint16_t* words, int64_t count, int64_t at, int64_t operations, const int64_t* state)
      : words_(words), count_(count), at_(at), operations_(operations) {
    for (int i = 0; i < kCodeLanes; ++i) state_[i] = static_cast<uint32_t>(state[i]);
  }
  // The place in [0, 2^15) of the next share.
  uint32_t place() const { return state_[operations_ & (kCodeLanes - 1)] & ((1u << kCodeBits) - 1); }
  // Leave the share that `place` lies in. After a bit a word is rare. After a symbol it follows one time in four or so, and a branch on that
  // would often be predicted wrongly.
  template <bool rare = false>
  void take(uint32_t start, uint32_t width) {
    uint32_t& x = state_[operations_++ & (kCodeLanes - 1)];
    x = width * (x >> kCodeBits) + (x & ((1u << kCodeBits) - 1)) - start;
    const uint32_t more = x < kCodeFloor;
    if (rare && !more) return;
    x = x << (16 * more) | (words_[std::min(at_, count_ - 1)] & (0u - more));
    at_ += more;
  }
  uint32_t raw(int bits) {  // 1 .. 15
    const int shift = kCodeBits - bits;
    const uint32_t value = place() >> shift;
    take(value << shift, 1u << shift);
    return value;
  }
  bool bit(uint32_t zeros) {
    const bool one = place() >= zeros;
    take<true>(one ? zeros : 0, one ? (1u << kCodeBits) - zeros : zeros);
    return one;
  }
  bool failed() const { return at_ > count_; }
  int64_t at() const { return at_; }
  int64_t operations() const { return operations_; }
  uint32_t state(int i) const { return state_[i]; }

 private:
  const uint16_t* words_;
  int64_t count_, at_, operations_;
  uint32_t state_[kCodeLanes];
};

// Collects operations, which `se_code_pack` turns into words.
class CodeOutput {
 public:
  bool bit(uint32_t zeros, bool one) {
    operations.push_back(one ? code_operation(zeros, (1u << kCodeBits) - zeros) : code_operation(0, zeros));
    return one;
  }
  std::vector<uint32_t> operations;
};

}  // namespace se
