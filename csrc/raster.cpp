// The C interface of the rasteriser; see se_api.h.
#include "raster.h"

#include <algorithm>
#include <mutex>
#include <new>

#if defined(__unix__) || defined(__APPLE__)
#include <time.h>
#else
#include <chrono>

#include "se_api.h"
#endif

namespace se::raster {
namespace {

// States return here when their graph is gone, so that the next image finds its memory already mapped.
class StatePool {
 public:
  std::unique_ptr<State> acquire() {
    std::lock_guard lock(mutex_);
    if (free_.empty()) return std::make_unique<State>();
    std::unique_ptr<State> state = std::move(free_.back());
    free_.pop_back();
    return state;
  }
  void release(std::unique_ptr<State> state) {
    std::lock_guard lock(mutex_);
    if (free_.size() < 2) free_.push_back(std::move(state));
  }
  void clear() {
    std::lock_guard lock(mutex_);
    free_.clear();
  }

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<State>> free_;
};

StatePool& state_pool() {
  static StatePool* instance = new StatePool;  // never destroyed: graphs may outlive static destructors at interpreter exit
  return *instance;
}

// Processor time of this thread if the system has it, so that a busy machine does not distort a benchmark.
double thread_seconds() {
#if defined(__unix__) || defined(__APPLE__)
  timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return static_cast<double>(t.tv_sec) + 1e-9 * static_cast<double>(t.tv_nsec);
#else
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
#endif
}

class StageTimer {
 public:
  explicit StageTimer(double* seconds) : seconds_(seconds), last_(thread_seconds()) {}
  void record() {
    const double time = thread_seconds();
    *seconds_++ = time - last_;
    last_ = time;
  }

 private:
  double* seconds_;
  double last_;
};

}  // namespace
}  // namespace se::raster

using namespace se::raster;

namespace {

template <class Call>
Inputs inputs_of(const Call& a) {
  return {a.means, a.quats, a.scales, a.opacities, a.colors};
}

}  // namespace

SE_EXPORT int32_t se_raster_forward(const SeRasterForward* a, void** state) {
  try {
    std::unique_ptr<State> s = state_pool().acquire();
    s->camera = a->camera;
    s->antialias = a->antialias != 0;
    s->m = a->m;
    s->tiles_x = (a->camera.width + kTile - 1) / kTile;
    s->tiles_y = (a->camera.height + kTile - 1) / kTile;
    StageTimer timer(s->seconds);
    project(*s, inputs_of(*a), a->radii, a->threads);
    timer.record();
    bin(*s, a->threads);
    timer.record();
    blend(*s, a->background, {a->image, a->alpha, a->depth}, a->threads);
    timer.record();
    if (state)
      *state = s.release();
    else
      state_pool().release(std::move(s));
    return 0;
  } catch (const std::exception&) {
    state_pool().clear();
    return 1;
  }
}

SE_EXPORT int32_t se_raster_backward(void* state, const SeRasterBackward* a) {
  try {
    State& s = *static_cast<State*>(state);
    // With many workers, one row of sums per worker and Gaussian would take more memory than one row per pair.
    const bool slots = a->deterministic || (a->threads > 4 && a->threads * s.visible > s.pairs);
    const int rows = slots ? 0 : std::max(1, a->threads);
    StageTimer timer(s.seconds + 3);
    blend_backward(s, a->background, {a->g_image, a->g_alpha, a->g_depth}, a->d_background, rows, a->absolute != 0, a->threads);
    timer.record();
    const Gradients out{a->d_means, a->d_quats, a->d_scales, a->d_opacities, a->d_colors, a->d_mean2d, a->absolute != 0};
    project_backward(s, inputs_of(*a), out, rows, a->threads);
    timer.record();
    return 0;
  } catch (const std::exception&) {
    state_pool().clear();
    return 1;
  }
}

SE_EXPORT void se_raster_release(void* state) {
  if (state) state_pool().release(std::unique_ptr<State>(static_cast<State*>(state)));
}

SE_EXPORT void se_raster_find_visible(const SeCamera* camera, const float* means, const float* scales, int64_t m, uint8_t* visible,
                                      int32_t threads) {
  project_visible(*camera, means, scales, m, visible, threads);
}

SE_EXPORT void se_raster_count(const void* state, int64_t* counts, double* seconds) {
  const State& s = *static_cast<const State*>(state);
  int64_t blocks = 0;
  for (int t = 0; t < s.tiles(); ++t)
    for (int k = 0; k < static_cast<int>((s.tile_used.data()[t] + kBatch - 1) / kBatch); ++k)
      for (int b = 0; b < 16; ++b) blocks += s.drawn.data()[s.batch(t, k) * 16 + b];
  counts[0] = s.visible, counts[1] = s.pairs, counts[2] = blocks;
  std::copy(s.seconds, s.seconds + 5, seconds);
}
