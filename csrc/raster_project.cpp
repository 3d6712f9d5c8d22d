// Forward projection: records, tile rectangles, depth keys and radii; and the visibility filter.
#include "raster_project.h"

#include <algorithm>
#include <new>
#include <numeric>

#include "pool.h"

namespace se::raster {
namespace {

struct TileRange {  // tiles with a pixel centre inside the ellipse of alpha >= 1/255
  F32x16 x0, y0, x1, y1;
  Mask16 drawn;

  // Number of areas that the tiles lie in, also for lanes beyond the last Gaussian. A chunk's sum in one lane is
  // exact: at most 2^24 for kMaxAreas.
  F32x16 areas() const {
    const F32x16 inv = broadcast(1.0f / kArea);
    return keep(drawn, (ceil(x1 * inv) - floor(x0 * inv)) * (ceil(y1 * inv) - floor(y0 * inv)));
  }
};

TileRange find_tiles(const Projection& p, F32x16 log_opacity, F32x16 radius, int tiles_x, int tiles_y) {
  const F32x16 zero = broadcast(0.0f);
  const F32x16 above = log_opacity - broadcast(kMinAlphaLog2);
  // Slightly enlarged, so that rounding here never removes a pixel that the exact test of the blending keeps.
  const F32x16 sigmas = sqrt(max(above, zero) * broadcast(1.3862944f)) * broadcast(1.0005f);
  const F32x16 ex = fma(sigmas, sqrt(p.cxx), broadcast(0.01f)), ey = fma(sigmas, sqrt(p.cyy), broadcast(0.01f));
  const F32x16 inv = broadcast(1.0f / kTile), most_x = broadcast(static_cast<float>(tiles_x)),
               most_y = broadcast(static_cast<float>(tiles_y));
  TileRange r;
  r.x0 = min(max(ceil((p.u - ex - broadcast(kTile - 0.5f)) * inv), zero), most_x);
  r.y0 = min(max(ceil((p.v - ey - broadcast(kTile - 0.5f)) * inv), zero), most_y);
  r.x1 = min(max(floor((p.u + ex - broadcast(0.5f)) * inv) + broadcast(1.0f), zero), most_x);
  r.y1 = min(max(floor((p.v + ey - broadcast(0.5f)) * inv) + broadcast(1.0f), zero), most_y);
  r.drawn = ge(above, broadcast(-1e-4f)) & gt(radius, zero) & gt(r.x1, r.x0) & gt(r.y1, r.y0);
  return r;
}

struct RecordLanes {  // sixteen records, without the depth key
  F32x16 row[16];
  explicit RecordLanes(const Projection& p, F32x16 log_opacity, const F32x16 (&color)[3]) {
    const F32x16 whiten = broadcast(kWhiten), rx = broadcast(1.0f) / sqrt(p.cxx), rd = broadcast(1.0f) / sqrt(p.det);
    row[0] = whiten * p.cxx * rx * rd;  // l1 = sqrt(cxx / det)
    row[1] = color[0], row[2] = color[1], row[3] = color[2], row[4] = p.vz;
    row[5] = p.u, row[6] = p.v, row[7] = log_opacity;
    row[8] = broadcast(0.0f) - whiten * p.xy * rx * rd;  // l2 = -cxy / sqrt(cxx det)
    row[9] = whiten * rx;                                // l3 = 1 / sqrt(cxx)
    for (int k = 10; k < 16; ++k) row[k] = broadcast(0.0f);
    transpose(row);
  }
};

// Sum of sixteen integers.
uint32_t sum_integers(F32x16 a) {
  alignas(64) int32_t lane[16];
  store_int(lane, a);
  return static_cast<uint32_t>(std::accumulate(lane, lane + 16, int64_t{0}));
}

void project_chunk(State& s, const Inputs& in, int32_t* radii, int64_t begin, int64_t end) {
  const SeCamera& camera = s.camera;
  uint32_t at = static_cast<uint32_t>(begin);
  F32x16 entries = broadcast(0.0f);
  for (int64_t i = begin; i < end; i += 16) {
    const int count = static_cast<int>(std::min<int64_t>(16, end - i));
    F32x16 mean[3], quat[4], scale[3], color[3], opacity[1];
    load_columns(in.means + 3 * i, count, mean);
    Projection p;
    p.project_centre(camera, mean);
    s.group_first.data()[i / 16] = at;
    s.group_mask.data()[i / 16] = 0;
    const uint32_t valid = (1u << count) - 1;
    if (!(bits(p.front) & valid)) {
      std::fill(radii + i, radii + i + count, 0);
      continue;
    }
    load_columns(in.quats + 4 * i, count, quat);
    load_columns(in.scales + 3 * i, count, scale);
    p.project_shape(quat, scale);
    const F32x16 radius = p.radius(s.tiles_x, s.tiles_y);
    alignas(64) int32_t whole[16];
    store_int(whole, radius);
    std::copy(whole, whole + count, radii + i);
    if (!(bits(gt(radius, broadcast(0.0f))) & valid)) continue;
    load_columns(in.opacities + i, count, opacity);
    F32x16 o = opacity[0];
    if (s.antialias) o = o * sqrt(p.compensation2());
    const Mask16 positive = ge(o, broadcast(1e-30f)) & gt(broadcast(1e30f), o);
    const F32x16 log_opacity = select(positive, log2(select(positive, o, broadcast(1.0f))), broadcast(-100.0f));
    const TileRange r = find_tiles(p, log_opacity, radius, s.tiles_x, s.tiles_y);
    const uint32_t drawn = bits(r.drawn) & valid;
    s.group_mask.data()[i / 16] = static_cast<uint16_t>(drawn);
    if (!drawn) continue;
    entries = entries + r.areas();
    load_columns(in.colors + 3 * i, count, color);
    const RecordLanes lanes(p, log_opacity, color);
    alignas(64) int32_t x0[16], y0[16], x1[16], y1[16];
    alignas(64) uint32_t key_bits[16];  // positive floats sort like their bits
    store(reinterpret_cast<float*>(key_bits), p.vz);
    store_int(x0, r.x0), store_int(y0, r.y0), store_int(x1, r.x1), store_int(y1, r.y1);
    for (uint32_t left = drawn; left; left &= left - 1) {
      const int k = __builtin_ctz(left);
      Record& record = s.records.data()[at];
      store(reinterpret_cast<float*>(&record), lanes.row[k]);
      const Rect rect{static_cast<uint16_t>(x0[k]), static_cast<uint16_t>(y0[k]), static_cast<uint16_t>(x1[k]),
                      static_cast<uint16_t>(y1[k])};
      s.items.data()[at] = {key_bits[k], at, rect};
      ++at;
    }
  }
  s.chunk_entries.data()[begin / kChunk] = sum_integers(entries);
  s.chunk_count.data()[begin / kChunk] = at - static_cast<uint32_t>(begin);
}

}  // namespace

void project(State& s, const Inputs& in, int32_t* radii, int threads) {
  if (std::max(s.tiles_x, s.tiles_y) > kMaxTiles || s.areas() > kMaxAreas) throw std::bad_alloc();
  const size_t places = static_cast<size_t>(s.places());
  s.records.get(places), s.items.get(places), s.chunk_entries.get(places / kChunk);
  s.group_mask.get(places / 16), s.group_first.get(places / 16), s.chunk_count.get(places / kChunk);
  parallel_for(s.m, kChunk, threads, [&](int64_t begin, int64_t end, int) { project_chunk(s, in, radii, begin, end); });
}

void project_visible(const SeCamera& camera, const float* means, const float* scales, int64_t m, uint8_t* visible, int threads) {
  const int tiles_x = (camera.width + kTile - 1) / kTile, tiles_y = (camera.height + kTile - 1) / kTile;
  parallel_for(m, kChunk, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; i += 16) {
      const int count = static_cast<int>(std::min<int64_t>(16, end - i));
      F32x16 mean[3], scale[3];
      load_columns(means + 3 * i, count, mean);
      load_columns(scales + 3 * i, count, scale);
      Projection p;
      p.project_centre(camera, mean);
      p.project_unrotated(scale);
      const uint32_t drawn = bits(gt(p.radius(tiles_x, tiles_y), broadcast(0.0f)));
      for (int k = 0; k < count; ++k) visible[i + k] = drawn >> k & 1;
    }
  });
}

}  // namespace se::raster
