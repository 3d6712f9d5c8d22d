// Forward projection: records, tile rectangles, depth keys and radii; and the visibility filter.
#include "raster_project.h"

#include <algorithm>
#include <new>
#include <numeric>

#include "pool.h"

namespace se::raster {
namespace {

struct Reach {  // tiles that hold a pixel centre within the ellipse of alpha >= 1/255
  F16 x0, y0, x1, y1;
  M16 drawn;

  // How many areas these meet (lanes beyond the last Gaussian count too). A chunk's sum in one lane is exact: at most 2^24 for kMostAreas.
  F16 areas() const {
    const F16 inv = bcast(1.0f / kArea);
    return keep(drawn, (ceil(x1 * inv) - floor(x0 * inv)) * (ceil(y1 * inv) - floor(y0 * inv)));
  }
};

Reach reach(const Projection& p, F16 log_opacity, F16 radius, int tiles_x, int tiles_y) {
  const F16 zero = bcast(0.0f);
  const F16 above = log_opacity - bcast(kMinAlphaLog2);
  // A little more than needed, so that rounding here never takes a pixel from the exact test in the blending.
  const F16 sigmas = sqrt(max(above, zero) * bcast(1.3862944f)) * bcast(1.0005f);
  const F16 ex = fma(sigmas, sqrt(p.cxx), bcast(0.01f)), ey = fma(sigmas, sqrt(p.cyy), bcast(0.01f));
  const F16 inv = bcast(1.0f / kTile), most_x = bcast(static_cast<float>(tiles_x)), most_y = bcast(static_cast<float>(tiles_y));
  Reach r;
  r.x0 = min(max(ceil((p.u - ex - bcast(kTile - 0.5f)) * inv), zero), most_x);
  r.y0 = min(max(ceil((p.v - ey - bcast(kTile - 0.5f)) * inv), zero), most_y);
  r.x1 = min(max(floor((p.u + ex - bcast(0.5f)) * inv) + bcast(1.0f), zero), most_x);
  r.y1 = min(max(floor((p.v + ey - bcast(0.5f)) * inv) + bcast(1.0f), zero), most_y);
  r.drawn = ge(above, bcast(-1e-4f)) & gt(radius, zero) & gt(r.x1, r.x0) & gt(r.y1, r.y0);
  return r;
}

struct Lanes {  // the parts of sixteen records that are not their depth key
  F16 row[16];
  explicit Lanes(const Projection& p, F16 log_opacity, const F16 (&color)[3]) {
    const F16 whiten = bcast(kWhiten), rx = bcast(1.0f) / sqrt(p.cxx), rd = bcast(1.0f) / sqrt(p.det);
    row[0] = whiten * p.cxx * rx * rd;   // l1 = sqrt(cxx / det)
    row[1] = color[0], row[2] = color[1], row[3] = color[2], row[4] = p.vz;
    row[5] = p.u, row[6] = p.v, row[7] = log_opacity;
    row[8] = bcast(0.0f) - whiten * p.xy * rx * rd;  // l2 = -cxy / sqrt(cxx det)
    row[9] = whiten * rx;                            // l3 = 1 / sqrt(cxx)
    for (int k = 10; k < 16; ++k) row[k] = bcast(0.0f);
    transpose(row);
  }
};

// The sum of sixteen whole numbers.
uint32_t whole_sum(F16 a) {
  alignas(64) int32_t lane[16];
  store_int(lane, a);
  return static_cast<uint32_t>(std::accumulate(lane, lane + 16, int64_t{0}));
}

void project_chunk(State& s, const Inputs& in, int32_t* radii, int64_t begin, int64_t end) {
  const SeCamera& camera = s.camera;
  uint32_t at = static_cast<uint32_t>(begin);
  F16 entries = bcast(0.0f);
  for (int64_t i = begin; i < end; i += 16) {
    const int count = static_cast<int>(std::min<int64_t>(16, end - i));
    F16 mean[3], quat[4], scale[3], color[3], opacity[1];
    load_columns(in.means + 3 * i, count, mean);
    Projection p;
    p.centre(camera, mean);
    s.group_first.data()[i / 16] = at;
    s.group_mask.data()[i / 16] = 0;
    const uint32_t valid = (1u << count) - 1;
    if (!(bits(p.front) & valid)) {
      std::fill(radii + i, radii + i + count, 0);
      continue;
    }
    load_columns(in.quats + 4 * i, count, quat);
    load_columns(in.scales + 3 * i, count, scale);
    p.shape(quat, scale);
    const F16 radius = p.radius(s.tiles_x, s.tiles_y);
    alignas(64) int32_t whole[16];
    store_int(whole, radius);
    std::copy(whole, whole + count, radii + i);
    if (!(bits(gt(radius, bcast(0.0f))) & valid)) continue;
    load_columns(in.opacities + i, count, opacity);
    F16 o = opacity[0];
    if (s.antialias) o = o * sqrt(p.compensation2());
    const M16 positive = ge(o, bcast(1e-30f)) & gt(bcast(1e30f), o);
    const F16 log_opacity = select(positive, log2(select(positive, o, bcast(1.0f))), bcast(-100.0f));
    const Reach r = reach(p, log_opacity, radius, s.tiles_x, s.tiles_y);
    const uint32_t drawn = bits(r.drawn) & valid;
    s.group_mask.data()[i / 16] = static_cast<uint16_t>(drawn);
    if (!drawn) continue;
    entries = entries + r.areas();
    load_columns(in.colors + 3 * i, count, color);
    const Lanes lanes(p, log_opacity, color);
    alignas(64) int32_t x0[16], y0[16], x1[16], y1[16];
    alignas(64) uint32_t key_bits[16];  // positive floats order as their bits do
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
  s.chunk_entries.data()[begin / kChunk] = whole_sum(entries);
  s.chunk_count.data()[begin / kChunk] = at - static_cast<uint32_t>(begin);
}

}  // namespace

void project(State& s, const Inputs& in, int32_t* radii, int threads) {
  if (s.areas() > kMostAreas) throw std::bad_alloc();
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
      F16 mean[3], scale[3];
      load_columns(means + 3 * i, count, mean);
      load_columns(scales + 3 * i, count, scale);
      Projection p;
      p.centre(camera, mean);
      p.shape_unrotated(scale);
      const uint32_t drawn = bits(gt(p.radius(tiles_x, tiles_y), bcast(0.0f)));
      for (int k = 0; k < count; ++k) visible[i + k] = drawn >> k & 1;
    }
  });
}

}  // namespace se::raster
