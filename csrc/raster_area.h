// One area of 4 x 4 tiles: sort its Gaussians by depth and count those of each tile.
#pragma once
#include <algorithm>
#include <bit>
#include <utility>

#include "raster_tile.h"

namespace se::raster {

class AreaSort {
 public:
  AreaSort() {
    for (int mask = 0; mask < 256; ++mask)
      for (int k = 0; k < 8; ++k) bytes_[mask] |= static_cast<uint64_t>(mask >> k & 1) << 8 * k;
  }

  // Read the area's n entries and count those of each tile. The entries of a part are begin[0] .. begin[1] - 1
  // in the part's row of `stride` numbers; a part has `places` places.
  void read(const Entry* entries, const uint32_t* begin, int64_t parts, int stride, int64_t places, uint32_t n,
            uint32_t (&count)[kArea * kArea]) {
    n_ = n;
    uint64_t *key = a_.get(n), *value = value_.get(n), sum[2] = {};
    std::fill(count, count + kArea * kArea, 0u);
    uint32_t i = 0, room = kRoom, low = UINT32_MAX, high = 0;
    for (int64_t p = 0; p < parts; ++p, begin += stride) {
      if (p + kFar < parts)
        for (uint32_t e = begin[kFar * stride]; e < begin[kFar * stride + 1]; e += 8) __builtin_prefetch(entries + e);
      for (const Entry *e = entries + begin[0], *end = entries + begin[1]; e < end; ++e, ++i) {
        const uint32_t k = static_cast<uint32_t>(*e >> 32), tiles = *e & 0xffff;
        low = std::min(low, k), high = std::max(high, k);
        key[i] = static_cast<uint64_t>(k) << 32 | i;
        value[i] = static_cast<uint64_t>(tiles) << 32 | (p * places + (*e >> 16 & 0xffff));
        sum[0] += bytes_[tiles & 255], sum[1] += bytes_[tiles >> 8];
        if (--room == 0) add(sum, count), room = kRoom;
      }
    }
    low_ = low, high_ = high;
    add(sum, count);
  }

  // Write places and tiles from near to far; the sort is stable.
  void operator()(uint32_t* places, uint16_t* tiles) {
    const uint64_t *order = sort(), *value = value_.data();
    for (uint32_t i = 0; i < n_; ++i) {
      const uint64_t v = value[static_cast<uint32_t>(order[i])];
      places[i] = static_cast<uint32_t>(v), tiles[i] = static_cast<uint16_t>(v >> 32);
    }
  }

 private:
  // Each byte of a number counts for one tile, until one of them could overflow.
  static void add(uint64_t (&sum)[2], uint32_t (&count)[kArea * kArea]) {
    for (int k = 0; k < kArea * kArea; ++k) count[k] += sum[k / 8] >> 8 * (k % 8) & 255;
    sum[0] = sum[1] = 0;
  }

  // Sort by key (upper half); the lower half is the number of the entry. Two counting passes over the leading
  // bits of the range of keys, with fewer bits for fewer entries, leave an almost sorted sequence.
  const uint64_t* sort() {
    const uint32_t n = n_, low = low_;
    uint64_t *a = a_.data(), *b = b_.get(n);
    if (n <= kFew) {
      sort_by_insertion(a, n);
      return a;
    }
    const int digit = std::clamp(static_cast<int>(std::bit_width(n)) - 1, 6, kMaxDigit);
    const int shift = std::max(0, static_cast<int>(std::bit_width(high_ - low)) - 2 * digit);
    const uint32_t radix = 1u << digit;
    std::fill(first_, first_ + radix, 0u), std::fill(second_, second_ + radix, 0u);
    const auto lead = [=](uint64_t x) { return (static_cast<uint32_t>(x >> 32) - low) >> shift; };
    for (uint32_t i = 0; i < n; ++i) ++first_[lead(a[i]) & (radix - 1)], ++second_[lead(a[i]) >> digit];
    uint32_t sum[2] = {};
    for (uint32_t d = 0; d < radix; ++d)
      first_[d] = std::exchange(sum[0], sum[0] + first_[d]), second_[d] = std::exchange(sum[1], sum[1] + second_[d]);
    for (uint32_t i = 0; i < n; ++i) b[first_[lead(a[i]) & (radix - 1)]++] = a[i];
    for (uint32_t i = 0; i < n; ++i) a[second_[lead(b[i]) >> digit]++] = b[i];
    if (shift > 0) finish_sort(a, n, lead);
    return a;
  }

  template <class F>
  static void finish_sort(uint64_t* a, uint32_t n, const F& lead) {
    for (uint32_t i = kFew; i < n; ++i)
      if (lead(a[i]) == lead(a[i - kFew])) {  // a long run with the same leading bits
        std::sort(a, a + n);
        return;
      }
    sort_by_insertion(a, n);
  }

  static void sort_by_insertion(uint64_t* a, uint32_t n) {
    for (uint32_t i = 1; i < n; ++i) {
      const uint64_t x = a[i];
      uint32_t k = i;
      for (; k > 0 && a[k - 1] > x; --k) a[k] = a[k - 1];
      a[k] = x;
    }
  }

  static constexpr uint32_t kFew = 32;
  static constexpr int kMaxDigit = 11;
  static constexpr uint32_t kRoom = 255;
  static constexpr int kFar = 4;    // prefetch distance in parts
  Buffer<uint64_t> a_, b_, value_;  // a_: keys as read
  uint32_t n_ = 0, low_ = 0, high_ = 0;
  uint32_t first_[1 << kMaxDigit], second_[1 << kMaxDigit];
  uint64_t bytes_[256] = {};
};

}  // namespace se::raster
