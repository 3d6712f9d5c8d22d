// Packing by tables, for instruction sets that cannot compress a register.
#pragma once
#include <cstdint>
#include <cstring>

namespace se {

// Write (first + lane) * Step for each lane of the mask to the front of the sixteen values at `to`.
template <int Step>
struct Packing {
  alignas(16) uint16_t places[256][8] = {};  // for each mask of eight lanes

  Packing() {
    for (int mask = 0; mask < 256; ++mask)
      for (int lane = 0, at = 0; lane < 8; ++lane)
        if (mask >> lane & 1) places[mask][at++] = static_cast<uint16_t>(lane * Step);
  }

  void pack(uint16_t* to, uint32_t mask, int first) const {
    pack_eight(to, mask & 255, first);
    pack_eight(to + __builtin_popcount(mask & 255), mask >> 8, first + 8);
  }

 private:
  typedef uint16_t U16x8 __attribute__((vector_size(16)));
  void pack_eight(uint16_t* to, uint32_t mask, int first) const {
    U16x8 packed;
    std::memcpy(&packed, places[mask], 16);
    packed += static_cast<uint16_t>(first * Step);
    std::memcpy(to, &packed, 16);
  }
};

// Copy the places whose tiles have the bit to `to` and return their end. `to` needs room for n + 16; reads up to
// 16 beyond n.
struct Picking {
  uint32_t* operator()(uint32_t* to, const uint32_t* place, const uint16_t* tiles, uint32_t n, int bit) const {
    for (uint32_t i = 0; i < n; ++i) *to = place[i], to += tiles[i] >> bit & 1;
    return to;
  }
};

}  // namespace se
