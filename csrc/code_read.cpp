// Reading of the entropy coder of compact files. The slow form is src/scene_experts/files/codec/reference.py.
#include <algorithm>
#include <cstdint>

#include "code.h"
#include "se_api.h"
#include "status.h"

namespace se {
namespace {
constexpr int64_t kTogether = 512;  // symbols whose places are found together

struct Places {
  uint16_t table[kTogether];
  uint8_t low[kTogether];
  int32_t centre[kTogether];
};
void find_places(const int32_t* mean, const int32_t* scale, int64_t count, Places& out) {
  for (int64_t i = 0; i < count; ++i) {
    const CodePlace at = find_place(mean[i], scale[i]);
    out.table[i] = static_cast<uint16_t>(at.table);
    out.low[i] = static_cast<uint8_t>(at.low);
    out.centre[i] = at.centre;
  }
}

int32_t keep(SeCodeReader* reader, const CodeInput& input) {
  reader->at = input.at();
  reader->operations = input.operations();
  for (int i = 0; i < kCodeLanes; ++i) reader->state[i] = input.state(i);
  return input.failed() ? kDamaged : 0;
}

// Read symbols from `i` on, up to the first one that escapes or that may need words beyond the end, and return which it is. The four states
// have names, which move on by one after each operation, so that they stay in registers.
int64_t read_plain(SeCodeReader* reader, const CodeTables& tables, const Places& places, int64_t i, int64_t count, int32_t* values) {
  static_assert(kCodeLanes == 4);
  constexpr uint32_t mask = (1u << kCodeBits) - 1;
  const auto state = [&](int64_t j) { return static_cast<uint32_t>(reader->state[(reader->operations + j) % kCodeLanes]); };
  uint32_t a = state(0), b = state(1), c = state(2), d = state(3);
  const uint16_t* words = reader->words + reader->at;
  const uint16_t* const last = reader->words + reader->count - 2;  // a symbol takes at most two
  int64_t operations = reader->operations;
  const auto take = [&](uint32_t x) {
    const uint32_t more = x < kCodeFloor;  // no branch: it would often be predicted wrongly
    x = x << (16 * more) | (*words & (0u - more));
    words += more;
    a = b, b = c, c = d, d = x;
    ++operations;
  };
  for (; i < count && words <= last; ++i) {
    const uint16_t* row = tables.below[places.table[i]];
    const uint32_t place = a & mask;
    int entry = tables.start[places.table[i]][place >> 8];
    entry += row[entry + 1] <= place;
    while (row[entry + 1] <= place) ++entry;  // rarely
    if (entry == kCodeSymbols - 1) break;
    take((row[entry + 1] - row[entry]) * (a >> kCodeBits) + place - row[entry]);
    int32_t symbol = entry - kCodeHalf;
    if (const int low = places.low[i]) {
      const int shift = kCodeBits - low;
      const uint32_t own = a & mask;
      take((a >> kCodeBits << shift) + (own & ((1u << shift) - 1)));
      symbol = symbol * (1 << low) + static_cast<int32_t>(own >> shift) - (1 << low >> 1);
    }
    values[i] = symbol + places.centre[i];
  }
  reader->at = words - reader->words;
  reader->operations = operations;
  const uint32_t states[kCodeLanes] = {a, b, c, d};
  for (int j = 0; j < kCodeLanes; ++j) reader->state[(operations + j) % kCodeLanes] = states[j];
  return i;
}

// Read one symbol of any kind.
int32_t read_any(SeCodeReader* reader, const CodeTables& tables, const CodePlace& at, int32_t* value) {
  CodeInput input(reader->words, reader->count, reader->at, reader->operations, reader->state);
  const uint16_t* row = tables.below[at.table];
  const uint32_t place = input.place();
  int entry = tables.start[at.table][place >> 8];
  while (row[entry + 1] <= place) ++entry;
  input.take(row[entry], row[entry + 1] - row[entry]);
  int64_t symbol = entry - kCodeHalf;
  if (entry == kCodeSymbols - 1) {
    const uint32_t form = input.raw(7);
    const int bits = static_cast<int>(form >> 1);
    if (bits > 32) return kDamaged;
    uint64_t beyond = 1;
    for (int left = bits; left > 0;) {
      const int part = std::min(left, kCodeBits);
      left -= part;
      beyond = beyond << part | input.raw(part);
    }
    symbol = static_cast<int64_t>(beyond) + kCodeHalf;
    if (form & 1) symbol = -symbol;
  }
  if (at.low) symbol = symbol * (1 << at.low) + input.raw(at.low) - (1 << at.low >> 1);
  symbol += at.centre;
  if (symbol < INT32_MIN || symbol > INT32_MAX) return kDamaged;
  *value = static_cast<int32_t>(symbol);
  return keep(reader, input);
}
}  // namespace
}  // namespace se

using namespace se;

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

SE_EXPORT int32_t se_code_read(SeCodeReader* reader, const int32_t* mean, const int32_t* scale, int64_t count, int32_t* values) {
  const CodeTables& tables = code_tables();
  Places places;
  for (int64_t begin = 0; begin < count; begin += kTogether) {
    const int64_t n = std::min(kTogether, count - begin);
    find_places(mean + begin, scale + begin, n, places);
    for (int64_t i = 0; (i = read_plain(reader, tables, places, i, n, values + begin)) < n; ++i) {
      const CodePlace at{places.table[i], places.centre[i], places.low[i]};
      if (const int32_t status = read_any(reader, tables, at, values + begin + i)) return status;
    }
  }
  return 0;
}

SE_EXPORT int32_t se_code_read_bits(SeCodeReader* reader, const int32_t* odds, int64_t count, uint8_t* bits) {
  const CodeTables& tables = code_tables();
  CodeInput input(reader->words, reader->count, reader->at, reader->operations, reader->state);
  for (int64_t i = 0; i < count && !input.failed(); ++i) bits[i] = input.bit(tables.zeros[std::clamp(odds[i], 0, kCodeTopOdds)]);
  return keep(reader, input);
}

SE_EXPORT void se_code_restore(const int32_t* whole, int64_t N, int64_t C, const float* steps, const float* scale, float* out) {
  constexpr int64_t kRows = 16, kColumns = 64;  // of a block, which stays in the cache while it is turned
  for (int64_t first = 0; first < C; first += kColumns)
    for (int64_t begin = 0; begin < N; begin += kRows) {
      const int64_t n = std::min(kRows, N - begin), m = std::min(kColumns, C - first);
      float block[kColumns][kRows];
      for (int64_t c = 0; c < m; ++c) {
        const int32_t* row = whole + (first + c) * N + begin;
        const float step = steps[first + c];
        for (int64_t i = 0; i < n; ++i) block[c][i] = static_cast<float>(row[i]) * step * (scale ? scale[begin + i] : 1.0f);
      }
      for (int64_t i = 0; i < n; ++i)
        for (int64_t c = 0; c < m; ++c) out[(begin + i) * C + first + c] = block[c][i];
    }
}
