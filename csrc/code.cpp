// Tables and symbols of the entropy coder of compact files. The slow form is src/scene_experts/files/codec/reference.py.
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

// The logistic distribution function at t / 8 steps.
int64_t below(int scale, int64_t t) {
  const int64_t slope = kSlopes[scale & 7] >> (scale >> 3);
  return t <= 0 ? tail(-t * slope) : (int64_t{1} << kShare) - tail(t * slope);
}

CodeTables make_tables() {
  CodeTables tables;
  for (int i = 0; i < kCodeScales; ++i)
    for (int p = 0; p < kCodePhases; ++p) {
      uint16_t* row = tables.below[i * kCodePhases + p];
      const int64_t first = below(i, -8 * kCodeHalf - p);
      for (int s = 0; s < kCodeSymbols; ++s)
        row[s] = static_cast<uint16_t>(s + ((below(i, 8 * (s - kCodeHalf) - p) - first) * ((1 << kCodeBits) - kCodeSymbols) >> kShare));
      row[kCodeSymbols] = 1 << kCodeBits;
      uint8_t* start = tables.start[i * kCodePhases + p];
      int s = 0;
      for (int share = 0; share < 128; ++share) {
        while (row[s + 1] <= share << 8) ++s;
        start[share] = static_cast<uint8_t>(s);
      }
    }
  for (int i = 0; i <= kCodeTopScale; ++i) {  // wide ones have their low bits apart, and no phase
    const int low = i < kCodeScales ? 0 : ((i - kCodeScales) >> 3) + 1, row = (i - 8 * low) * kCodePhases;
    tables.scales[i] = {static_cast<uint16_t>(low ? row + 4 : row), static_cast<uint8_t>(low ? 0 : 7), static_cast<uint8_t>(low)};
  }
  for (int i = 0; i <= kCodeTopOdds; ++i) {
    const int64_t least = tail(static_cast<int64_t>(std::abs(i - 64)) << (kFraction - 3));  // the share of the rarer bit
    const int64_t zeros = i <= 64 ? (int64_t{1} << kShare) - least : least;
    tables.zeros[i] = static_cast<uint16_t>(1 + (zeros * ((1 << kCodeBits) - 2) >> kShare));
  }
  return tables;
}

// Where a symbol lies: its table, its centre, and how many low bits are stored as they are.
struct Place {
  const uint16_t* row;
  const uint8_t* start;
  int32_t centre;
  int low;
};
inline Place find_place(const CodeTables& tables, int32_t mean, int32_t scale) {
  const CodeTables::Scale& of = tables.scales[std::clamp(scale, 0, kCodeTopScale)];
  const int32_t centre = (mean + 4) >> 3;
  const int index = of.row + ((mean - 8 * centre + 4) & of.phase);
  return {tables.below[index], tables.start[index], centre, of.low};
}
constexpr int32_t kFarthest = 1 << 28;  // means are clamped to +- this
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
    const Place at = find_place(tables, std::clamp(mean[i], -kFarthest, kFarthest), scale[i]);
    const int64_t away = static_cast<int64_t>(values[i]) - at.centre + ((int64_t{1} << at.low) >> 1), symbol = away >> at.low;
    const bool escapes = symbol < -kCodeHalf || symbol > kCodeHalf;
    const int entry = escapes ? kCodeSymbols - 1 : static_cast<int>(symbol) + kCodeHalf;
    *out++ = code_operation(at.row[entry], at.row[entry + 1] - at.row[entry]);
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
    if (at.low) raw(static_cast<uint32_t>(away & ((1 << at.low) - 1)), at.low);
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
    if (x >= width << 17) {
      *--out = static_cast<uint16_t>(x);
      x >>= 16;
    }
    x = (x / width << kCodeBits) + x % width + start;
  }
  for (int i = kCodeLanes; i-- > 0;) {
    *--out = static_cast<uint16_t>(state[i] >> 16);
    *--out = static_cast<uint16_t>(state[i]);
  }
  const int64_t used = words + capacity - out;
  std::memmove(words, out, static_cast<size_t>(used) * sizeof(uint16_t));
  return used;
}

SE_EXPORT int32_t se_code_start(SeCodeReader* reader) {
  if (reader->count < 2 * kCodeLanes) return kDamaged;
  for (int i = 0; i < kCodeLanes; ++i) {
    const uint32_t state = reader->words[2 * i] | static_cast<uint32_t>(reader->words[2 * i + 1]) << 16;
    if (state < kCodeFloor) return kDamaged;
    reader->state[i] = state;
  }
  reader->at = 2 * kCodeLanes;
  reader->operations = 0;
  return 0;
}

namespace {
int32_t leave(SeCodeReader* reader, const CodeInput& input, bool failed) {
  reader->at = input.at();
  reader->operations = input.operations();
  for (int i = 0; i < kCodeLanes; ++i) reader->state[i] = input.state(i);
  return failed || input.failed() ? kDamaged : 0;
}
}  // namespace

SE_EXPORT int32_t se_code_read(SeCodeReader* reader, const int32_t* mean, const int32_t* scale, int64_t count, int32_t* values) {
  const CodeTables& tables = code_tables();
  CodeInput input(reader->words, reader->count, reader->at, reader->operations, reader->state);
  bool failed = false;
  for (int64_t i = 0; i < count && !input.failed(); ++i) {
    const Place at = find_place(tables, std::clamp(mean[i], -kFarthest, kFarthest), scale[i]);
    const uint32_t share = input.place();
    int entry = at.start[share >> 8];
    while (at.row[entry + 1] <= share) ++entry;
    input.take(at.row[entry], at.row[entry + 1] - at.row[entry]);
    int64_t symbol = entry - kCodeHalf;
    if (entry == kCodeSymbols - 1) {
      const uint32_t form = input.raw(7);
      const int bits = static_cast<int>(form >> 1);
      if (bits > 32) {
        failed = true;
        break;
      }
      uint64_t beyond = 1;
      for (int left = bits; left > 0;) {
        const int part = std::min(left, kCodeBits);
        left -= part;
        beyond = beyond << part | input.raw(part);
      }
      symbol = static_cast<int64_t>(beyond) + kCodeHalf;
      if (form & 1) symbol = -symbol;
    }
    int64_t value = symbol;
    if (at.low) value = (symbol << at.low) + input.raw(at.low) - ((int64_t{1} << at.low) >> 1);
    value += at.centre;
    if (value < INT32_MIN || value > INT32_MAX) {
      failed = true;
      break;
    }
    values[i] = static_cast<int32_t>(value);
  }
  return leave(reader, input, failed);
}

SE_EXPORT int32_t se_code_read_bits(SeCodeReader* reader, const int32_t* odds, int64_t count, uint8_t* bits) {
  const CodeTables& tables = code_tables();
  CodeInput input(reader->words, reader->count, reader->at, reader->operations, reader->state);
  for (int64_t i = 0; i < count && !input.failed(); ++i) bits[i] = input.bit(tables.zeros[std::clamp(odds[i], 0, kCodeTopOdds)]);
  return leave(reader, input, false);
}
