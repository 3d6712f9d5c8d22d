// Types shared by the stages of the CPU rasteriser. render/reference.py defines the image; this code computes it
// in four stages:
//
//   project    every Gaussian -> a 64-byte Record (whitened ellipse, colour, depth) and its rectangle of tiles
//   bin        a stable scatter into areas of 4 x 4 tiles of 16 x 16 pixels, then per area a sort by depth and the tile lists
//   blend      per tile: find the 4 x 4 pixel blocks that each Gaussian touches (exactly), then blend block by block, one per F32x16
//   backward   per tile, from the last batch to the first, starting from the forward pass's checkpoints; sums per Gaussian; then the
//              chain rule through the projection
//
// Whitened ellipse: with d = centre - pixel, log2 of a Gaussian's value is log_opacity - (l1 dy + l2 dx)^2 - (l3
// dx)^2. This sum of squares has no cancellation for thin Gaussians and costs two operations per block of a
// tile: height[x] = log_opacity - (l3 dx)^2 and slope[x] = l1 (v - centre of the tile) + l2 dx are computed once
// per column x of the tile, and then p = height - (slope - l1 y)^2.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#elif defined(_WIN32)
#include <malloc.h>
#endif

#include "se_api.h"

namespace se::raster {

constexpr int kTile = 16;             // pixels
constexpr int kArea = 4;              // tiles
constexpr int kMaxTiles = 65535;      // of a side: coordinates of tiles have 16 bits
constexpr int kMaxAreas = 65536;      // of an image: 268 million pixels
constexpr int kChunk = 4096;          // Gaussians per job of the projection; a multiple of 16
constexpr int kBatch = 512;           // Gaussians of a tile processed at a time: the end of a batch costs every block some hundred cycles
constexpr int kAhead = 128;           // prefetch distance in the list of a tile
constexpr int kBeyond = kAhead + 16;  // entries after the last list, so that prefetching needs no test
constexpr float kMaxAlpha = 0.99f, kMinTransmittance = 1e-4f;
constexpr float kMinAlphaLog2 = -7.994353437f;  // log2(1 / 255)
constexpr float kWhiten = 0.84932180f;          // sqrt(log2(e) / 2)

// A visible Gaussian; colour and ellipse come first because blending reads them.
struct alignas(64) Record {
  float l1, r, g, b, z, u, v, log_opacity, l2, l3, spare[6];
};
static_assert(sizeof(Record) == 64);

struct Rect {  // tiles, end exclusive
  uint16_t x0, y0, x1, y1;
};

struct alignas(16) Item {
  uint32_t key, place;  // bits of the depth; place of the record
  Rect rect;
};
static_assert(sizeof(Item) == 16);

// A Gaussian in one area: its key, 16 bits for its number in its part, and bit 4 y + x for the area's tile in
// column x, row y.
using Entry = uint64_t;
constexpr int kMaxPartChunks = 65536 / kChunk;  // chunks per part, at most

// Sums over pixels for one Gaussian, with W = d loss / d power at a pixel: W, W dx, W dy, W dx^2, W dx dy, W
// dy^2, then colour and depth. kAbsoluteX and kAbsoluteY are the sums of |W dp / du| and |W dp / dv| / (2 ln 2), where p is the power and
// (u, v) the centre; 0 unless asked for. The other entries below kSums are 0: a tile keeps the Gaussian's own numbers there, in the same
// cache line.
struct alignas(64) Sums {
  float x[16];
};
enum { kAbsoluteX = 0, kAbsoluteY = 1, kDepth = 4, kS = 7, kSx, kSy, kSxx, kSxy, kSyy, kRed, kGreen, kBlue, kSums = kS };

// Uninitialised memory that only grows. Large buffers ask for huge pages, because random reads would miss the
// TLB otherwise.
template <class T>
class Buffer {
 public:
  T* get(size_t n) {
    if (n > size_) {
      data_.reset();
      size_ = 0;
      const size_t grown = n + n / 8;
      data_.reset(static_cast<T*>(allocate(grown * sizeof(T))));
      size_ = grown;
    }
    return data_.get();
  }
  T* data() const { return data_.get(); }

 private:
  static constexpr size_t kHuge = size_t{1} << 21;
  static void* allocate(size_t bytes) {
    if (bytes < kHuge) return allocate_aligned(bytes, 64);
    void* p = allocate_aligned(bytes, kHuge);
#if defined(__linux__)
    madvise(p, bytes, MADV_HUGEPAGE);
#endif
    return p;
  }
  static void* allocate_aligned(size_t bytes, size_t alignment) {
    const size_t rounded = (bytes + alignment) / alignment * alignment;
#if defined(_WIN32)
    void* p = _aligned_malloc(rounded, alignment);
#else
    void* p = std::aligned_alloc(alignment, rounded);
#endif
    if (!p) throw std::bad_alloc();
    return p;
  }
  struct Free {
    void operator()(T* p) const {
#if defined(_WIN32)
      _aligned_free(p);
#else
      std::free(p);
#endif
    }
  };
  std::unique_ptr<T[], Free> data_;
  size_t size_ = 0;
};

// Everything that the backward pass of one image needs, and the scratch memory of the stages. Reused from image
// to image.
struct State {
  SeCamera camera{};
  int64_t m = 0, visible = 0, pairs = 0;
  int tiles_x = 0, tiles_y = 0;
  bool antialias = false;

  Buffer<Record> records;          // [m rounded up to chunks]; the visible Gaussians of chunk c start at c * kChunk
  Buffer<Item> items;              // in the same order
  Buffer<uint16_t> group_mask;     // [m / 16] which of sixteen neighbours are visible
  Buffer<uint32_t> group_first;    // [m / 16] place of the first visible one
  Buffer<uint32_t> chunk_count;    // [chunks] visible Gaussians
  Buffer<uint32_t> chunk_entries;  // [chunks] entries of their Gaussians
  Buffer<uint32_t> part_begin;     // [parts + 1] first entry
  Buffer<uint32_t> area_begin;     // [parts, areas + 1] first entry
  Buffer<uint32_t> area_at;        // [areas + 1] number of entries before each area's
  Buffer<uint32_t> tile_begin;     // [tiles + 1] first element of `list`
  Buffer<uint32_t> tile_used;      // [tiles] how much of its list a tile used before all its pixels stopped
  Buffer<uint32_t> list;           // [pairs] places, per tile near to far
  Buffer<uint16_t> masks;          // [batches, 16 blocks, kBatch / 16] which blocks of a tile each Gaussian touches, see batch()
  Buffer<uint16_t> drawn;          // [batches, 16 blocks] how many Gaussians were blended before all pixels of the block stopped
  Buffer<float> transmittance;     // [tiles * 256] final transmittance, in block order
  Buffer<float> checkpoints;       // [batches * 256] transmittance before each batch except a tile's first, see batch()
  Buffer<Sums> sums;               // backward: one row per place and worker, or (deterministic) per pair; binning uses the memory too
  Buffer<uint32_t> slots;          // deterministic backward: first row of each place
  Buffer<double> background;       // backward: [tiles * 3]

  double seconds[5] = {};  // processor time of the calling thread: project, bin, blend, blend backward, project backward

  int tiles() const { return tiles_x * tiles_y; }
  // One extra column and row, which stay empty: rectangles end there.
  int areas_x() const { return (tiles_x + kArea - 1) / kArea + 1; }
  int areas() const { return areas_x() * ((tiles_y + kArea - 1) / kArea + 1); }
  // A distinct number for each batch of each tile, without a table.
  int64_t batch(int tile, int index) const { return static_cast<int64_t>(tile_begin.data()[tile]) / kBatch + tile + index; }
  size_t batches() const { return static_cast<size_t>(pairs / kBatch + tiles() + 1); }
  int64_t places() const { return (m + kChunk - 1) / kChunk * kChunk; }
};

struct Inputs {
  const float *means, *quats, *scales, *opacities, *colors;  // [m, 3] [m, 4] [m, 3] [m] [m, 3]
};

struct Outputs {
  float *image, *alpha, *depth;  // [H, W, 3] [H, W] [H, W]
};

struct Upstream {
  const float *image, *alpha, *depth;  // gradients of the outputs; null: zero
};

struct Gradients {
  float *means, *quats, *scales, *opacities, *colors, *mean2d;
  bool absolute;  // mean2d: the sums of the absolute values of the pixels' gradients
};

// Project all Gaussians: fill records, items, groups per chunk, and radii [m].
void project(State& s, const Inputs& in, int32_t* radii, int threads);
// Find which unrotated Gaussians are visible.
void project_visible(const SeCamera& camera, const float* means, const float* scales, int64_t m, uint8_t* visible, int threads);
// Sort by depth and fill the lists of the tiles.
void bin(State& s, int threads);
void blend(State& s, const float* background, const Outputs& out, int threads);
// Fill `sums` and the background's gradient. `rows`: rows of sums per Gaussian (0: one slot per pair). `absolute`: fill the sums of absolute
// values too.
void blend_backward(State& s, const float* background, const Upstream& up, float* g_background, int rows, bool absolute, int threads);
void project_backward(State& s, const Inputs& in, const Gradients& out, int rows, int threads);

}  // namespace se::raster
