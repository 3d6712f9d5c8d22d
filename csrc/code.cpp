// Tables and writing of the entropy coder of compact files. The slow form is src/scene_experts/files/codec/reference.py.
#include "code.h"

#include <algorithm>
#include <cstring>

#include "se_api.h"
#include "status.h"

namespace se {
namespace {
constexpr int kFraction = 26, kShare = 20;  // bits after the point: of powers of two, of probabilities
// round(2^27 log2(e) 2^(-j / 8)): 1 / scale of table j in units of 1/8 of a step, for powers of two.
constexpr int64_t kSlopes[8] = {193635251, 177564308, 162827188, 149313190, 136920799, 125556926, 115136209, 105580369};
// round(2^26 2^(-2^-b)), b = 1 .. 16
constexpr int64_t kRoots[16] = {47453133, 56431603, 61539100, 64263668, 65670859, 66385968, 66746437, 66927405,
                                67018073, 67063453, 67086155, 67097508, 67103186, 67106025, 67107444, 67108154};

// 2^-u of u >= 0, both with 26 bits after the point.
int64_t power(int64_t u) {
  const int64_t whole = u >> kFraction;
  if (whole >= kFraction) return 0;
  int64_t e = int64_t{1} << kFraction;
  for (int b = 1; b <= 16; ++b)
    if (u >> (kFraction - b) & 1) e = e * kRoots[b - 1] >> kFraction;
  return e >> whole;
}

// 1 / (1 + 2^u) of u >= 0, 20 bits after the point.
int64_t tail(int64_t u) {
  const int64_t e = power(u);
  return (e << kShare) / ((int64_t{1} << kFraction) + e);
}

CodeTables make_tables() {
  CodeTables tables;
  for (int i = 0; i < kCodeScales; ++i) {
    constexpr int kMost = 8 * kCodeHalf + 8;
    int64_t tails[kMost + 1];  // beyond t / 8 steps, t = 0, 1 ...
    for (int t = 0; t <= kMost; ++t) tails[t] = tail(t * (kSlopes[i & 7] >> (i >> 3)));
    const auto below = [&](int t) { return t <= 0 ? tails[-t] : (int64_t{1} << kShare) - tails[t]; };  // the logistic distribution function
    for (int p = 0; p < kCodePhases; ++p) {
      uint16_t* row = tables.below[i * kCodePhases + p];
      const int64_t first = below(-8 * kCodeHalf - p);
      for (int s = 0; s < kCodeSymbols; ++s)
        row[s] = static_cast<uint16_t>(s + ((below(8 * (s - kCodeHalf) - p) - first) * ((1 << kCodeBits) - kCodeSymbols) >> kShare));
      row[kCodeSymbols] = 1 << kCodeBits;
      uint8_t* start = tables.start[i * kCodePhases + p];
      int s = 0;
      for (int share = 0; share < 128; ++share) {
        while (row[s + 1] <= share << 8) ++s;
        start[share] = static_cast<uint8_t>(s);
      }
    }
  }
  for (int i = 0; i <= kCodeTopOdds; ++i) {
    const int64_t least = tail(static_cast<int64_t>(std::abs(i - 64)) << (kFraction - 3));  // the share of the rarer bit
    const int64_t zeros = i <= 64 ? (int64_t{1} << kShare) - least : least;
    tables.zeros[i] = static_cast<uint16_t>(1 + (zeros * ((1 << kCodeBits) - 2) >> kShare));
  }
  return tables;
}
}  // namespace

const CodeTables& code_tables() {
  static const CodeTables tables = make_tables();
  return tables;
}
}  // namespace se

using namespace se;

SE_EXPORT int64_t se_code_symbols(const int32_t* values, const int32_t* mean, const int32_t* scale, int64_t count, uint32_t* operations) {
  const CodeTables& tables = code_tables();
  uint32_t* out = operations;
  const auto raw = [&](uint32_t value, int bits) { *out++ = code_operation(value << (kCodeBits - bits), 1u << (kCodeBits - bits)); };
  for (int64_t i = 0; i < count; ++i) {
    const CodePlace at = find_place(mean[i], scale[i]);
    const uint16_t* row = tables.below[at.table];
    const int64_t away = static_cast<int64_t>(values[i]) - at.centre + ((int64_t{1} << at.low) >> 1), symbol = away >> at.low;
    const bool escapes = symbol < -kCodeHalf || symbol > kCodeHalf;
    const int entry = escapes ? kCodeSymbols - 1 : static_cast<int>(symbol) + kCodeHalf;
    *out++ = code_operation(row[entry], row[entry + 1] - row[entry]);
    if (escapes) {
      const uint64_t beyond = static_cast<uint64_t>(symbol < 0 ? -symbol : symbol) - kCodeHalf;  // 1 and more
      int bits = 0;
      while (beyond >> (bits + 1)) ++bits;
      raw(static_cast<uint32_t>(bits << 1 | (symbol < 0)), 7);
      for (int left = bits; left > 0;) {
        const int part = std::min(left, kCodeBits);
        left -= part;
        raw(static_cast<uint32_t>(beyond >> left & ((1u << part) - 1)), part);
      }
    }
    *out = code_operation(static_cast<uint32_t>(away & ((1 << at.low) - 1)) << (kCodeBits - at.low), 1u << (kCodeBits - at.low));
    out += at.low > 0;  // no branch: it would often be predicted wrongly
  }
  return out - operations;
}

SE_EXPORT void se_code_bits(const uint8_t* bits, const int32_t* odds, int64_t count, uint32_t* operations) {
  const CodeTables& tables = code_tables();
  for (int64_t i = 0; i < count; ++i) {
    const uint32_t zeros = tables.zeros[std::clamp(odds[i], 0, kCodeTopOdds)];
    operations[i] = bits[i] ? code_operation(zeros, (1u << kCodeBits) - zeros) : code_operation(0, zeros);
  }
}

SE_EXPORT int64_t se_code_pack(const uint32_t* operations, int64_t count, uint16_t* words) {
  uint32_t state[kCodeLanes];
  std::fill(state, state + kCodeLanes, kCodeFloor);
  const int64_t capacity = count + 2 * kCodeLanes;
  uint16_t* out = words + capacity;
  for (int64_t i = count; i-- > 0;) {
    uint32_t& x = state[i & (kCodeLanes - 1)];
    const uint32_t start = operations[i] >> 16, width = operations[i] & 0xFFFF;
    const uint32_t more = x >= width << 17;  // no branch: it would often be predicted wrongly
    out[-1] = static_cast<uint16_t>(x);
    out -= more;
    x >>= 16 * more;
    const uint32_t quotient = x / width;
    x = (quotient << kCodeBits) + (x - quotient * width) + start;
  }
  for (int i = kCodeLanes; i-- > 0;) {
    *--out = static_cast<uint16_t>(state[i] >> 16);
    *--out = static_cast<uint16_t>(state[i]);
  }
  const int64_t used = words + capacity - out;
  std::memmove(words, out, static_cast<size_t>(used) * sizeof(uint16_t));
  return used;
}
