// Compare depths with the depths of other views: of a view's pixels, and of points.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "pool.h"
#include "status.h"
#include "sweep.h"

namespace {

constexpr int64_t POINTS = 256;  // per chunk

std::vector<se::SweepCamera> cameras_of(const SeSweep& call) {
  std::vector<se::SweepCamera> out;
  out.reserve(static_cast<size_t>(call.views));
  for (int64_t view = 0; view < call.views; ++view) out.emplace_back(call, view);
  return out;
}

}  // namespace

SE_EXPORT int32_t se_sweep_agree(const SeSweep* call, const int64_t* first, const int32_t* others, float strong, float weak,
                                 double tolerance, int32_t* agree) {
  return se::run_guarded([&] {
    const std::vector<se::SweepCamera> cameras = cameras_of(*call);
    se::parallel_for(call->views, 1, call->threads, [&](int64_t begin, int64_t end, int) {
      for (int64_t view = begin; view < end; ++view) {
        const se::SweepCamera& from = cameras[view];
        for (int64_t at = call->start[view]; at < call->start[view + 1]; ++at) {
          agree[at] = 0;
          if (!(call->score[at] > strong)) continue;
          const int64_t pixel = at - call->start[view];
          const double z = 1.0 / call->inverse[at];
          const double u = static_cast<double>(pixel % from.width) + 0.5, v = static_cast<double>(pixel / from.width) + 0.5;
          const double here[3] = {(u - from.cx) / from.fx * z, (v - from.cy) / from.fy * z, z};
          double world[3], there[3];
          from.to_world(here, world);
          for (int64_t i = first[view]; i < first[view + 1]; ++i) {
            const se::SweepCamera& to = cameras[others[i]];
            to.to_camera(world, there);
            const int64_t shown = to.pixel_of(there);
            if (shown < 0) continue;
            const int64_t found = call->start[others[i]] + shown;
            if (!(call->score[found] > weak)) continue;
            agree[at] += std::abs(1.0 / (call->inverse[found] * there[2]) - 1.0) < tolerance;
          }
        }
      }
    });
  });
}

SE_EXPORT int32_t se_sweep_compare(const SeSweep* call, const double* points, int64_t count, double front, double near_by,
                                   int32_t* before, int32_t* on) {
  return se::run_guarded([&] {
    const std::vector<se::SweepCamera> cameras = cameras_of(*call);
    se::parallel_for(count, POINTS, call->threads, [&](int64_t begin, int64_t end, int) {
      std::fill(before + begin, before + end, 0), std::fill(on + begin, on + end, 0);
      for (int64_t view = 0; view < call->views; ++view) {
        const float* inverse = call->inverse + call->start[view];
        for (int64_t i = begin; i < end; ++i) {
          double there[3];
          cameras[view].to_camera(points + 3 * i, there);
          const int64_t shown = cameras[view].pixel_of(there);
          if (shown < 0 || inverse[shown] == 0.f) continue;
          const double ratio = there[2] * inverse[shown];
          before[i] += ratio < 1.0 - front;
          on[i] += std::abs(ratio - 1.0) < near_by;
        }
      }
    });
  });
}
