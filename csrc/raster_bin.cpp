// Build the tile lists in two steps whose jobs are independent and stay in the cache. First, each part of the
// Gaussians is scattered into areas of 4 x 4 tiles (a stable scatter). Then each area is sorted by depth and the
// lists of its tiles are written.
#include <algorithm>
#include <utility>

#include "pool.h"
#include "raster_area.h"

namespace se::raster {
namespace {

// Chunks per part. It grows with the number of areas, so that an area's share of a part is more than a single
// Gaussian.
int64_t chunks_per_part(const State& s) { return std::min<int64_t>(1 + s.areas() / 128, kMaxPartChunks); }

// Count visible Gaussians and find the first entry of each part. Return the number of entries.
uint64_t number_entries(State& s, int64_t parts) {
  const int64_t chunks = s.places() / kChunk;
  uint32_t* begin = s.part_begin.get(static_cast<size_t>(parts) + 1);
  uint64_t sum = 0;
  s.visible = 0;
  for (int64_t c = 0; c < chunks; ++c) {
    if (c % chunks_per_part(s) == 0) begin[c / chunks_per_part(s)] = static_cast<uint32_t>(sum);
    s.visible += s.chunk_count.data()[c], sum += s.chunk_entries.data()[c];
    if (sum > UINT32_MAX) throw std::bad_alloc();
  }
  begin[parts] = static_cast<uint32_t>(sum);
  return sum;
}

// Move bit y of four to bit 4 y.
inline uint32_t spread_bits(uint32_t rows) {
  static constexpr uint16_t bits[16] = {0x0000, 0x0001, 0x0010, 0x0011, 0x0100, 0x0101, 0x0110, 0x0111,
                                        0x1000, 0x1001, 0x1010, 0x1011, 0x1100, 0x1101, 0x1110, 0x1111};
  return bits[rows];
}

// An entry during the scatter: area, the item's number in its part, and tiles, in one number that is written at
// once.
inline uint64_t pack(uint64_t area, uint64_t number, uint64_t tiles) { return area << 32 | number << 16 | tiles; }

// Write an item's entries, one for each area that it touches, and return their end. Up to 2 x 2 areas take no
// branch on their number.
uint64_t* write_entries(const Rect r, uint64_t number, uint32_t areas_x, uint64_t* to) {
  const uint32_t x = r.x0 / kArea, y = r.y0 / kArea, from_x = r.x0 % kArea, from_y = r.y0 % kArea;
  const uint32_t end_x = r.x1 - x * kArea, end_y = r.y1 - y * kArea;
  if (std::max(end_x, end_y) > 2 * kArea) {
    for (uint32_t j = 0; j * kArea < end_y; ++j)
      for (uint32_t i = 0; i * kArea < end_x; ++i) {
        const uint32_t columns = (1u << std::min<uint32_t>(end_x - i * kArea, kArea)) - (i == 0 ? 1u << from_x : 1u);
        const uint32_t rows = (1u << std::min<uint32_t>(end_y - j * kArea, kArea)) - (j == 0 ? 1u << from_y : 1u);
        *to++ = pack((y + j) * areas_x + x + i, number, columns * spread_bits(rows));
      }
    return to;
  }
  const uint32_t columns = (1u << end_x) - (1u << from_x), rows = (1u << end_y) - (1u << from_y);  // of two areas, four bits each
  const uint32_t left = columns & 15, right = columns >> 4, top = spread_bits(rows & 15), bottom = spread_bits(rows >> 4);
  const uint64_t first = pack(y * areas_x + x, number, 0), beside = pack(1, 0, 0), below = pack(areas_x, 0, 0);
  *to = first | left * top, ++to;
  *to = (first + beside) | right * top, to += right > 0;
  *to = (first + below) | left * bottom, to += bottom > 0;
  *to = (first + below + beside) | right * bottom, to += (right > 0) & (bottom > 0);
  return to;
}

// Scatter one part: write the entries of its chunks, area by area, to `entries`; `begin` [areas + 1] gives the
// first of each area.
void scatter(const State& s, int64_t part, Entry* entries, uint32_t* begin) {
  const int areas = s.areas();
  const uint32_t first = s.part_begin.data()[part], n = s.part_begin.data()[part + 1] - first;
  const int64_t first_chunk = part * chunks_per_part(s), last_chunk = std::min(s.places() / kChunk, first_chunk + chunks_per_part(s));
  const Item* items = s.items.data() + first_chunk * kChunk;
  uint64_t *flat = thread_scratch<Buffer<uint64_t>>().get(n + 4), *end = flat;
  for (int64_t c = first_chunk; c < last_chunk; ++c) {
    const uint32_t from = static_cast<uint32_t>((c - first_chunk) * kChunk), to = from + s.chunk_count.data()[c];
    for (uint32_t i = from; i < to; ++i) {
      __builtin_prefetch(entries + first + (end - flat), 1);
      end = write_entries(items[i].rect, i, static_cast<uint32_t>(s.areas_x()), end);
    }
  }
  std::fill(begin, begin + areas + 1, 0u);
  for (const uint64_t* e = flat; e < end; ++e) ++begin[*e >> 32];
  uint32_t sum = first;
  for (int a = 0; a < areas; ++a) sum += std::exchange(begin[a], sum);
  begin[areas] = sum;
  for (const uint64_t* e = flat; e < end; ++e) {
    const uint64_t key = items[*e >> 16 & 0xffff].key;
    entries[begin[*e >> 32]++] = key << 32 | (*e & 0xffffffff);
  }
  for (int a = areas - 1; a > 0; --a) begin[a] = begin[a - 1];  // each begin is now the next area's: shift by one
  begin[0] = first;
}

// Call f(tile, its bit) for each tile of the area that lies in the image.
template <class F>
void for_each_tile(const State& s, int64_t area, F&& f) {
  const int x = static_cast<int>(area) % s.areas_x() * kArea, y = static_cast<int>(area) / s.areas_x() * kArea;
  for (int j = 0; j < std::min(kArea, s.tiles_y - y); ++j)
    for (int i = 0; i < std::min(kArea, s.tiles_x - x); ++i) f((y + j) * s.tiles_x + x + i, j * kArea + i);
}

// Turn list lengths into list begins and return the total length.
uint64_t number_lists(State& s) {
  uint32_t* begin = s.tile_begin.data();  // the lengths until now
  uint64_t sum = 0;
  for (int t = 0; t < s.tiles(); ++t) {
    sum += std::exchange(begin[t], static_cast<uint32_t>(sum));
    if (sum > UINT32_MAX - kBeyond) throw std::bad_alloc();
  }
  begin[s.tiles()] = static_cast<uint32_t>(sum);
  return sum;
}

}  // namespace

void bin(State& s, int threads) {
  const int areas = s.areas();
  const int64_t parts = (s.places() / kChunk + chunks_per_part(s) - 1) / chunks_per_part(s);
  const size_t total = number_entries(s, parts);
  // Until the backward pass needs `sums`, its memory holds the entries and, per area from near to far, their
  // places and tiles.
  const size_t room = total + kBeyond;
  Entry* entries = reinterpret_cast<Entry*>(s.sums.get(room * (sizeof(Entry) + sizeof(uint32_t) + sizeof(uint16_t)) / sizeof(Sums) + 1));
  uint32_t* places = reinterpret_cast<uint32_t*>(entries + room);
  uint16_t* tiles_of = reinterpret_cast<uint16_t*>(places + room);
  uint32_t* begin = s.area_begin.get(static_cast<size_t>(parts) * (areas + 1));
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) { scatter(s, p, entries, begin + p * (areas + 1)); });

  uint32_t* area_at = s.area_at.get(static_cast<size_t>(areas) + 1);
  std::fill(area_at, area_at + areas + 1, 0u);
  for (int64_t p = 0; p < parts; ++p)
    for (int a = 0; a < areas; ++a) area_at[a + 1] += begin[p * (areas + 1) + a + 1] - begin[p * (areas + 1) + a];
  for (int a = 0; a < areas; ++a) area_at[a + 1] += area_at[a];

  s.tile_used.get(static_cast<size_t>(s.tiles()));
  uint32_t* length = s.tile_begin.get(static_cast<size_t>(s.tiles()) + 1);
  parallel_for(areas, 1, threads, [&](int64_t a, int64_t, int) {
    AreaSort& sort = thread_scratch<AreaSort>();
    uint32_t count[kArea * kArea];
    sort.read(entries, begin + a, parts, areas + 1, chunks_per_part(s) * kChunk, area_at[a + 1] - area_at[a], count);
    sort(places + area_at[a], tiles_of + area_at[a]);
    for_each_tile(s, a, [&](int tile, int bit) { length[tile] = count[bit]; });
  });

  s.pairs = static_cast<int64_t>(number_lists(s));
  uint32_t* list = s.list.get(static_cast<size_t>(s.pairs) + kBeyond);
  parallel_for(areas, 1, threads, [&](int64_t a, int64_t, int) {
    const uint32_t n = area_at[a + 1] - area_at[a];
    uint32_t* picked = thread_scratch<Buffer<uint32_t>>().get(n + 16);
    const Picking pick;
    for_each_tile(s, a, [&](int tile, int bit) {
      const uint32_t* end = pick(picked, places + area_at[a], tiles_of + area_at[a], n, bit);
      std::copy(static_cast<const uint32_t*>(picked), end, list + s.tile_begin.data()[tile]);
    });
  });
  std::fill(list + s.pairs, list + s.pairs + kBeyond, s.pairs > 0 ? list[s.pairs - 1] : 0u);
}

}  // namespace se::raster
