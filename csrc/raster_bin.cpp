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

// Moves the chunks' keys and places together, in `keys2`, `order2`; returns how many, and the range of the keys.
int64_t gather(State& s, uint32_t& low, uint32_t& high) {
  const int64_t chunks = s.places() / kChunk;
  int64_t n = 0;
  for (int64_t c = 0; c < chunks; ++c) n += s.chunk_count.data()[c];
  uint32_t* keys = s.keys2.get(static_cast<size_t>(n));
  uint32_t* order = s.order2.get(static_cast<size_t>(n));
  low = UINT32_MAX, high = 0;
  int64_t at = 0;
  for (int64_t c = 0; c < chunks; ++c) {
    const uint32_t* from = s.keys.data() + c * kChunk;
    const int64_t count = s.chunk_count.data()[c];
    for (int64_t i = 0; i < count; ++i) {
      keys[at + i] = from[i];
      order[at + i] = static_cast<uint32_t>(c * kChunk + i);
      low = std::min(low, from[i]);
      high = std::max(high, from[i]);
    }
    at += count;
  }
  return n;
}

// One stable counting pass on kDigit bits of (key - low) >> shift.
void pass(State& s, const uint32_t* keys, const uint32_t* order, uint32_t* keys_out, uint32_t* order_out, int64_t n, uint32_t low,
          int shift, int parts, int threads) {
  uint32_t* histogram = s.histogram.get(static_cast<size_t>(parts) * kRadix);
  const auto digit = [&](uint32_t key) { return ((key - low) >> shift) & (kRadix - 1); };
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    uint32_t* count = histogram + p * kRadix;
    std::fill(count, count + kRadix, 0u);
    const Slice range = slice(n, static_cast<int>(p), parts);
    for (int64_t i = range.begin; i < range.end; ++i) ++count[digit(keys[i])];
  });
  uint32_t sum = 0;
  for (uint32_t d = 0; d < kRadix; ++d)
    for (int p = 0; p < parts; ++p) sum += std::exchange(histogram[p * kRadix + d], sum);
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    uint32_t* at = histogram + p * kRadix;
    const Slice range = slice(n, static_cast<int>(p), parts);
    for (int64_t i = range.begin; i < range.end; ++i) {
      const uint32_t to = at[digit(keys[i])]++;
      keys_out[to] = keys[i];
      order_out[to] = order[i];
    }
  });
}

// Two passes sort the 22 leading bits of the range; what is left are short runs, put in order one by one.
void finish_runs(uint32_t* keys, uint32_t* order, int64_t n, uint32_t low, int shift) {
  std::vector<std::pair<uint32_t, uint32_t>> long_run;
  for (int64_t i = 0; i < n;) {
    int64_t end = i + 1;
    while (end < n && (keys[end] - low) >> shift == (keys[i] - low) >> shift) ++end;
    if (end - i <= 32) {
      for (int64_t j = i + 1; j < end; ++j) {
        const uint32_t key = keys[j], place = order[j];
        int64_t k = j;
        for (; k > i && keys[k - 1] > key; --k) keys[k] = keys[k - 1], order[k] = order[k - 1];
        keys[k] = key, order[k] = place;
      }
    } else {
      long_run.clear();
      for (int64_t j = i; j < end; ++j) long_run.emplace_back(keys[j], order[j]);
      std::sort(long_run.begin(), long_run.end());  // places are unique and were ascending, so this is stable
      for (int64_t j = i; j < end; ++j) keys[j] = long_run[j - i].first, order[j] = long_run[j - i].second;
    }
    i = end;
  }
}

// Leaves the places of all visible Gaussians in `order`, near to far, ties by index.
void sort_depths(State& s, int threads) {
  uint32_t low, high;
  const int64_t n = s.visible = gather(s, low, high);
  if (n == 0) return;
  const int width = 32 - __builtin_clz((high - low) | 1u);
  const int shift = std::max(0, width - 2 * kDigit);
  const int parts = n < kSmall ? 1 : threads;
  pass(s, s.keys2.data(), s.order2.data(), s.keys.data(), s.order.data(), n, low, shift, parts, threads);
  pass(s, s.keys.data(), s.order.data(), s.keys2.data(), s.order2.data(), n, low, shift + kDigit, parts, threads);
  if (shift > 0) finish_runs(s.keys2.data(), s.order2.data(), n, low, shift);
}

// How many of a slice's rectangles hold each tile: each adds 1 at its first corner and takes it away past its sides; the running sums over
// rows and columns are the counts. (Four steps per rectangle, and no branch on its size.)
void count_tiles(const State& s, const uint32_t* order, Slice range, uint32_t* count) {
  const int width = s.tiles_x + 1, height = s.tiles_y + 1;
  std::vector<uint32_t> corner(static_cast<size_t>(width) * height, 0u);  // modulo 2^32, so that differences may be negative
  const Rect* rects = s.rects.data();
  for (int64_t i = range.begin; i < range.end; ++i) {
    __builtin_prefetch(&rects[order[std::min<int64_t>(i + kAhead, range.end - 1)]]);
    const Rect r = rects[order[i]];
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

void fill_lists(const State& s, const uint32_t* order, Slice range, uint32_t* at, uint32_t* list) {
  const Rect* rects = s.rects.data();
  for (int64_t i = range.begin; i < range.end; ++i) {
    __builtin_prefetch(&rects[order[std::min<int64_t>(i + kAhead, range.end - 1)]]);
    const uint32_t place = order[i];
    const Rect r = rects[place];
    for (int y = r.y0; y < r.y1; ++y)
      for (int x = r.x0; x < r.x1; ++x) list[at[y * s.tiles_x + x]++] = place;
  }
}

}  // namespace

void bin(State& s, int threads) {
  sort_depths(s, threads);
  const int64_t n = s.visible;
  const int tiles = s.tiles();
  const int parts = n < kSmall ? 1 : threads;
  const uint32_t* order = s.order2.data();
  uint32_t* counts = s.histogram.get(static_cast<size_t>(parts) * tiles);
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    count_tiles(s, order, slice(n, static_cast<int>(p), parts), counts + p * tiles);
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
    if (sum > UINT32_MAX - 64) throw std::bad_alloc();
  }
  begin[tiles] = static_cast<uint32_t>(sum);
  s.pairs = static_cast<int64_t>(sum);
  uint32_t* list = s.list.get(sum + kAhead);
  parallel_for(parts, 1, threads, [&](int64_t p, int64_t, int) {
    fill_lists(s, order, slice(n, static_cast<int>(p), parts), counts + p * tiles, list);
  });
  std::fill(list + sum, list + sum + kAhead, sum > 0 ? list[sum - 1] : 0u);
}

}  // namespace se::raster
