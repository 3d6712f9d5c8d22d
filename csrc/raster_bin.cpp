// One radix sort of the visible depths, then a stable scatter into the tiles' lists.
#include <algorithm>
#include <utility>
#include <vector>

#include "pool.h"
#include "raster.h"

namespace se::raster {
namespace {

constexpr int kDigit = 11;  // bits per pass
constexpr uint32_t kRadix = 1u << kDigit;
constexpr int64_t kSmall = 1 << 15;  // elements below which a second thread costs more than it brings

struct Slice {
  int64_t begin, end;
};

Slice slice(int64_t n, int part, int parts) { return {n * part / parts, n * (part + 1) / parts}; }

// Runs f(part, begin, end) over pieces of consecutive items: the first pass reads the chunks of the projection, the second one array.
template <class F>
void each_piece(const State& s, bool chunks, int64_t n, int part, int parts, F&& f) {
  if (!chunks) {
    const Slice range = slice(n, part, parts);
    f(range.begin, range.end);
    return;
  }
  const Slice range = slice(s.places() / kChunk, part, parts);
  for (int64_t c = range.begin; c < range.end; ++c) f(c * kChunk, c * kChunk + s.chunk_count.data()[c]);
}

// One stable counting pass on kDigit bits of (key - low) >> shift.
void pass(State& s, const Item* from, Item* to, bool chunks, uint32_t low, int shift, int parts, int threads) {
  uint32_t* histogram = s.histogram.get(static_cast<size_t>(parts) * kRadix);
  const auto digit = [=](const Item& item) { return ((item.key - low) >> shift) & (kRadix - 1); };
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    uint32_t* count = histogram + p * kRadix;
    std::fill(count, count + kRadix, 0u);
    each_piece(s, chunks, s.visible, static_cast<int>(p), parts, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) ++count[digit(from[i])];
    });
  });
  uint32_t sum = 0;
  for (uint32_t d = 0; d < kRadix; ++d)
    for (int p = 0; p < parts; ++p) sum += std::exchange(histogram[p * kRadix + d], sum);
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    uint32_t* at = histogram + p * kRadix;
    each_piece(s, chunks, s.visible, static_cast<int>(p), parts, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) to[at[digit(from[i])]++] = from[i];
    });
  });
}

// Two passes sort the 22 leading bits of the range; what is left are short runs, put in order one by one.
void finish_runs(Item* items, Slice range, uint32_t low, int shift) {
  const auto less = [](const Item& a, const Item& b) { return a.key != b.key ? a.key < b.key : a.place < b.place; };
  for (int64_t i = range.begin; i < range.end;) {
    const uint32_t run = (items[i].key - low) >> shift;
    int64_t end = i + 1;
    while (end < range.end && (items[end].key - low) >> shift == run) ++end;
    if (end - i > 32) {
      std::sort(items + i, items + end, less);  // places are unique and were ascending, so this is stable
    } else {
      for (int64_t j = i + 1; j < end; ++j) {
        const Item item = items[j];
        int64_t k = j;
        for (; k > i && items[k - 1].key > item.key; --k) items[k] = items[k - 1];
        items[k] = item;
      }
    }
    i = end;
  }
}

// A slice moved forward at both ends to where a run begins, so that no run is cut.
Slice whole_runs(const Item* items, int64_t n, Slice range, uint32_t low, int shift) {
  const auto forward = [&](int64_t i) {
    while (i > 0 && i < n && (items[i].key - low) >> shift == (items[i - 1].key - low) >> shift) ++i;
    return i;
  };
  return {forward(range.begin), forward(range.end)};
}

// All visible Gaussians, near to far, ties by index, in memory that backward will overwrite.
const Item* sort_depths(State& s, int threads) {
  const int64_t chunks = s.places() / kChunk;
  uint32_t low = UINT32_MAX, high = 0;
  int64_t n = 0;
  for (int64_t c = 0; c < chunks; ++c) {
    n += s.chunk_count.data()[c];
    low = std::min(low, s.chunk_low.data()[c]), high = std::max(high, s.chunk_high.data()[c]);
  }
  s.visible = n;
  static_assert(sizeof(Sums) == 4 * sizeof(Item));
  Item *half = reinterpret_cast<Item*>(s.sums.get(static_cast<size_t>(n + 1) / 2)), *sorted = half + n;
  if (n == 0) return sorted;
  const int width = 32 - __builtin_clz((high - low) | 1u);
  const int shift = std::max(0, width - 2 * kDigit);
  const int parts = n < kSmall ? 1 : threads;
  pass(s, s.items.data(), half, true, low, shift, parts, threads);
  pass(s, half, sorted, false, low, shift + kDigit, parts, threads);
  if (shift == 0) return sorted;
  std::vector<Slice> ranges;
  for (int p = 0; p < parts; ++p) ranges.push_back(whole_runs(sorted, n, slice(n, p, parts), low, shift));
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) { finish_runs(sorted, ranges[p], low, shift); });
  return sorted;
}

// How many of a slice's rectangles hold each tile: each adds 1 at its first corner and takes it away past its sides; the running sums over
// rows and columns are the counts. (Four steps per rectangle, and no branch on its size.)
void count_tiles(const State& s, const Item* items, Slice range, uint32_t* count) {
  const int width = s.tiles_x + 1, height = s.tiles_y + 1;
  std::vector<uint32_t> corner(static_cast<size_t>(width) * height, 0u);  // modulo 2^32, so that differences may be negative
  for (int64_t i = range.begin; i < range.end; ++i) {
    const Rect r = items[i].rect;
    ++corner[r.y0 * width + r.x0];
    --corner[r.y0 * width + r.x1];
    --corner[r.y1 * width + r.x0];
    ++corner[r.y1 * width + r.x1];
  }
  for (int y = 0; y < s.tiles_y; ++y) {
    uint32_t along = 0;
    for (int x = 0; x < s.tiles_x; ++x) {
      along += corner[y * width + x];
      count[y * s.tiles_x + x] = along + (y > 0 ? count[(y - 1) * s.tiles_x + x] : 0u);
    }
  }
}

// Tiles of rectangles one after the other, some hundreds at a time: written without a branch on a rectangle's size, then read in one loop.
class Flat {
 public:
  explicit Flat(int tiles_x) : tiles_x_(tiles_x) {
    for (int width = 1; width <= kMost; ++width)
      for (int i = 0; i < kMost; ++i) offset_[width][i] = static_cast<uint32_t>(i / width * tiles_x + i % width);
  }
  bool full() const { return count_ > kRoom - 2 * kMost; }
  // Takes a rectangle of at most kMost tiles; returns false for others.
  bool add(const Item& item) {
    const Rect r = item.rect;
    const int width = r.x1 - r.x0, area = width * (r.y1 - r.y0);
    if (area > kMost) return false;
    const uint32_t first = static_cast<uint32_t>(r.y0 * tiles_x_ + r.x0);
    const uint32_t* offset = offset_[width];
    for (int i = 0; i < kMost; ++i) tile_[count_ + i] = first + offset[i];
    for (int i = 0; i < kMost; ++i) place_[count_ + i] = item.place;
    count_ += area;
    return true;
  }
  void flush(uint32_t* at, uint32_t* list) {
    for (int i = 0; i < kMost; ++i) tile_[count_ + i] = tile_[0];
    for (int i = 0; i < count_; ++i) {
      __builtin_prefetch(&list[at[tile_[i + kMost]]], 1);  // every tile writes elsewhere
      list[at[tile_[i]]++] = place_[i];
    }
    count_ = 0;
  }

 private:
  static constexpr int kMost = 16, kRoom = 512 + 16;
  int tiles_x_, count_ = 0;
  alignas(64) uint32_t offset_[kMost + 1][kMost] = {};
  alignas(64) uint32_t tile_[kRoom], place_[kRoom];
};

void fill_lists(const State& s, const Item* items, Slice range, uint32_t* at, uint32_t* list) {
  Flat flat(s.tiles_x);
  for (int64_t i = range.begin; i < range.end; ++i) {
    const bool large = !flat.add(items[i]);
    if (large || flat.full()) flat.flush(at, list);
    if (!large) continue;
    const Rect r = items[i].rect;
    for (int y = r.y0; y < r.y1; ++y)
      for (int x = r.x0; x < r.x1; ++x) list[at[y * s.tiles_x + x]++] = items[i].place;
  }
  flat.flush(at, list);
}

}  // namespace

void bin(State& s, int threads) {
  const Item* items = sort_depths(s, threads);
  const int64_t n = s.visible;
  const int tiles = s.tiles();
  const int parts = n < kSmall ? 1 : threads;
  uint32_t* counts = s.histogram.get(static_cast<size_t>(parts) * tiles);
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    count_tiles(s, items, slice(n, static_cast<int>(p), parts), counts + p * tiles);
  });
  uint32_t* begin = s.tile_begin.get(static_cast<size_t>(tiles) + 1);
  s.tile_used.get(static_cast<size_t>(tiles));
  uint64_t sum = 0;
  for (int t = 0; t < tiles; ++t) {
    begin[t] = static_cast<uint32_t>(sum);
    for (int p = 0; p < parts; ++p) {
      const uint32_t count = counts[p * tiles + t];
      counts[p * tiles + t] = static_cast<uint32_t>(sum);
      sum += count;
    }
    if (sum > UINT32_MAX - kBeyond) throw std::bad_alloc();
  }
  begin[tiles] = static_cast<uint32_t>(sum);
  s.pairs = static_cast<int64_t>(sum);
  uint32_t* list = s.list.get(sum + kBeyond);
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    fill_lists(s, items, slice(n, static_cast<int>(p), parts), counts + p * tiles, list);
  });
  std::fill(list + sum, list + sum + kBeyond, sum > 0 ? list[sum - 1] : 0u);
}

}  // namespace se::raster
