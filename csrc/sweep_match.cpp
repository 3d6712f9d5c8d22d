// A plane sweep (Collins 1996): for each pixel of a view, the inverse depth at which the other views look most alike.
//
// Planes are parallel to the view's picture and uniform in inverse depth. The plane at inverse depth w maps a view's pixels to another
// view by the homography K' (R + w t n^T) K^-1, n = (0, 0, 1), where [R | t] leads from the view to the other. Similarity is the
// zero-mean normalised cross-correlation (ZNCC) of windows of 7 x 7 pixels, with variances of at least EPS. The score of a plane is the
// mean of the two most similar views, so that a pixel may be hidden in the others. The best plane wins, and a parabola through the
// scores beside it gives the fraction of a plane.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "pool.h"
#include "status.h"
#include "sweep.h"

namespace {

constexpr int RADIUS = 3;
constexpr float WINDOW = (2 * RADIUS + 1) * (2 * RADIUS + 1);
constexpr float EPS = 4.f;       // grey levels squared, about the noise of a photograph
constexpr float TEXTURE = 9.f;   // least variance of a window that has a depth
constexpr float VOID = -1000.f;  // a pixel without a value
// A window with VOID and without it has at least 1/49 48/49 1000^2 as its variance; one of grey levels alone at most 127.5^2 = 16256.
constexpr float BROKEN = 17000.f;

template <class F>
inline float sum_of_seven(F&& value) {
  return ((value(0) + value(1)) + (value(2) + value(3))) + ((value(4) + value(5)) + value(6));
}

// Sums over columns of seven pixels of a row of windows: of w, w^2 and w g. A row is short, so they stay in the cache.
class Columns {
 public:
  explicit Columns(int W) : W_(W), sum_(W), squares_(W), cross_(W) {}

  // w and g: the first of seven rows.
  void fill(const float* __restrict w, const float* __restrict g) {
    float *__restrict sum = sum_.data(), *__restrict squares = squares_.data(), *__restrict cross = cross_.data();
    const int64_t W = W_;
    for (int64_t x = 0; x < W; ++x) {
      sum[x] = sum_of_seven([&](int64_t k) { return w[x + k * W]; });
      squares[x] = sum_of_seven([&](int64_t k) { return w[x + k * W] * w[x + k * W]; });
      cross[x] = sum_of_seven([&](int64_t k) { return w[x + k * W] * g[x + k * W]; });
    }
  }

  // Means over the window around x.
  float mean(int64_t x) const { return over(sum_.data(), x); }
  float mean_square(int64_t x) const { return over(squares_.data(), x); }
  float mean_product(int64_t x) const { return over(cross_.data(), x); }

 private:
  static float over(const float* __restrict row, int64_t x) {
    return sum_of_seven([&](int64_t k) { return row[x - RADIUS + k]; }) / WINDOW;
  }

  int64_t W_;
  std::vector<float> sum_, squares_, cross_;
};

// The homography of each plane is base + w slope.
struct Warp {
  double base[9], slope[9];

  Warp(const se::SweepCamera& from, const se::SweepCamera& to) {
    double R[9], t[3], K[9] = {to.fx, 0, to.cx, 0, to.fy, to.cy, 0, 0, 1};
    for (int i = 0; i < 3; ++i) {
      const double* row = to.R + 3 * i;
      for (int j = 0; j < 3; ++j) R[3 * i + j] = row[0] * from.R[3 * j] + row[1] * from.R[3 * j + 1] + row[2] * from.R[3 * j + 2];
      t[i] = to.t[i] - (R[3 * i] * from.t[0] + R[3 * i + 1] * from.t[1] + R[3 * i + 2] * from.t[2]);
    }
    for (int i = 0; i < 3; ++i) {
      double a[3], b = 0;
      for (int j = 0; j < 3; ++j) a[j] = K[3 * i] * R[j] + K[3 * i + 1] * R[3 + j] + K[3 * i + 2] * R[6 + j];
      for (int j = 0; j < 3; ++j) b += K[3 * i + j] * t[j];
      base[3 * i] = a[0] / from.fx, base[3 * i + 1] = a[1] / from.fy;  // times K^-1 from the right
      base[3 * i + 2] = a[2] - a[0] * from.cx / from.fx - a[1] * from.cy / from.fy;
      slope[3 * i] = slope[3 * i + 1] = 0, slope[3 * i + 2] = b;
    }
  }
};

// out [W H] = the pixels of `to` that the plane shows at the pixels of the view; VOID outside and where a pixel does not count.
void warp(const Warp& by, double w, const float* picture, int32_t width, int32_t height, int W, int H, float* out) {
  float h[9];
  for (int i = 0; i < 9; ++i) h[i] = static_cast<float>(by.base[i] + w * by.slope[i]);
  const float right = static_cast<float>(width - 1), bottom = static_cast<float>(height - 1);
  for (int y = 0; y < H; ++y) {
    const float cy = static_cast<float>(y) + 0.5f;
    const float u0 = h[1] * cy + h[2], v0 = h[4] * cy + h[5], z0 = h[7] * cy + h[8];
    float* __restrict row = out + static_cast<int64_t>(y) * W;
    for (int x = 0; x < W; ++x) {
      const float cx = static_cast<float>(x) + 0.5f;
      const float z = h[6] * cx + z0, per = 1.f / z;
      const float u = (h[0] * cx + u0) * per - 0.5f, v = (h[3] * cx + v0) * per - 0.5f;
      const float a = u > 0.f ? u : 0.f, b = v > 0.f ? v : 0.f;  // not a number: 0
      const float ax = a < right ? a : right, by_ = b < bottom ? b : bottom;
      const int32_t i = std::min(static_cast<int32_t>(ax), width - 2), j = std::min(static_cast<int32_t>(by_), height - 2);
      const float fx = ax - static_cast<float>(i), fy = by_ - static_cast<float>(j);
      const int32_t at = j * width + i;
      const float p = picture[at], q = picture[at + 1], r = picture[at + width], s = picture[at + width + 1];
      const float top = p + fx * (q - p), low = r + fx * (s - r), value = top + fy * (low - top);
      const float least = std::min(std::min(p, q), std::min(r, s));
      row[x] = (z > 0.f) & (u == ax) & (v == by_) & (least >= 0.f) ? value : VOID;
    }
  }
}

// The sweep of one view.
class Sweep {
 public:
  Sweep(const SeSweep& call, int64_t view)
      : call_(call), from_(call, view), view_(view), W_(from_.width), H_(from_.height), n_(static_cast<int64_t>(W_) * H_), columns_(W_) {}

  void run() {
    const float* source = call_.grey + call_.start[view_];
    std::vector<float> grey(source, source + n_);
    for (float& g : grey) g = g < 0.f ? VOID : g;
    warped_.resize(n_), mean_.assign(n_, 0.f), variance_.assign(n_, 2 * BROKEN);
    each_row([&](int64_t row) {
      columns_.fill(grey.data() + row, grey.data() + row);
      for (int64_t x = RADIUS; x < W_ - RADIUS; ++x) {
        const float m = columns_.mean(x);
        mean_[at(row, x)] = m, variance_[at(row, x)] = std::max(columns_.mean_square(x) - m * m, 0.f);
      }
    });
    first_.resize(n_), second_.resize(n_);
    best_.assign(n_, -2.f), left_.assign(n_, -1.f), right_.assign(n_, -1.f), previous_.assign(n_, -1.f), plane_.assign(n_, -1);
    std::vector<std::pair<int64_t, Warp>> others;
    for (int64_t j = 0; j < call_.k; ++j)
      if (const int64_t other = call_.compared[view_ * call_.k + j]; other >= 0)
        others.emplace_back(other, Warp(from_, se::SweepCamera(call_, other)));
    const double begin = call_.planes[2 * view_], step = (call_.planes[2 * view_ + 1] - begin) / static_cast<double>(call_.count - 1);
    for (int64_t d = 0; d < call_.count; ++d) {
      std::fill(first_.begin(), first_.end(), -1.f), std::fill(second_.begin(), second_.end(), -1.f);
      for (const auto& [other, by] : others) {
        const int32_t width = call_.size[2 * other], height = call_.size[2 * other + 1];
        warp(by, begin + static_cast<double>(d) * step, call_.grey + call_.start[other], width, height, W_, H_, warped_.data());
        compare(grey.data());
      }
      choose(static_cast<int32_t>(d));
    }
    finish(begin, step);
  }

 private:
  // Call f(row) for each row of windows; row: the number of the first pixel of its first row.
  template <class F>
  void each_row(F&& f) {
    for (int64_t y = 0; y < H_ - 2 * RADIUS; ++y) f(y * W_);
  }

  // The number of the pixel in the middle of a window.
  int64_t at(int64_t row, int64_t x) const { return row + RADIUS * W_ + x; }

  // Put the ZNCC of the view and the warped picture among the two best of this plane.
  void compare(const float* grey) {
    each_row([&](int64_t row) {
      columns_.fill(warped_.data() + row, grey + row);
      const float *__restrict mean = mean_.data() + at(row, 0), *__restrict variance = variance_.data() + at(row, 0);
      float *__restrict first = first_.data() + at(row, 0), *__restrict second = second_.data() + at(row, 0);
      for (int64_t x = RADIUS; x < W_ - RADIUS; ++x) {
        const float m = columns_.mean(x), v = columns_.mean_square(x) - m * m, c = columns_.mean_product(x) - mean[x] * m;
        const float alike = c / std::sqrt((variance[x] + EPS) * ((v > 0.f ? v : 0.f) + EPS));
        const float s = (v > BROKEN) | (m < 0.f) ? -1.f : alike;
        const float low = s < first[x] ? s : first[x];
        first[x] = s > first[x] ? s : first[x];
        second[x] = low > second[x] ? low : second[x];
      }
    });
  }

  // Keep the best plane so far and the scores beside it.
  void choose(int32_t plane) {
    const float *__restrict first = first_.data(), *__restrict second = second_.data();
    float *__restrict best = best_.data(), *__restrict left = left_.data(), *__restrict right = right_.data();
    float* __restrict previous = previous_.data();
    int32_t* __restrict chosen = plane_.data();
    for (int64_t i = 0; i < n_; ++i) {
      const float s = 0.5f * (first[i] + second[i]);
      const bool better = s > best[i];
      right[i] = chosen[i] == plane - 1 ? s : right[i];
      left[i] = better ? previous[i] : left[i];
      best[i] = better ? s : best[i];
      chosen[i] = better ? plane : chosen[i];
      previous[i] = s;
    }
  }

  void finish(double begin, double step) {
    float *inverse = call_.inverse + call_.start[view_], *score = call_.score + call_.start[view_];
    std::fill(inverse, inverse + n_, 0.f), std::fill(score, score + n_, -1.f);
    each_row([&](int64_t row) {
      for (int64_t x = RADIUS; x < W_ - RADIUS; ++x) {
        const int64_t i = at(row, x);
        if (plane_[i] < 1 || plane_[i] > call_.count - 2 || variance_[i] < TEXTURE || variance_[i] > BROKEN || mean_[i] < 0.f) continue;
        const float bend = left_[i] - 2.f * best_[i] + right_[i];
        const float offset = bend < -1e-6f ? std::clamp(0.5f * (left_[i] - right_[i]) / bend, -0.5f, 0.5f) : 0.f;
        inverse[i] = static_cast<float>(begin + (plane_[i] + static_cast<double>(offset)) * step);
        score[i] = best_[i];
      }
    });
  }

  const SeSweep& call_;
  se::SweepCamera from_;
  int64_t view_;
  int W_, H_;
  int64_t n_;
  Columns columns_;
  std::vector<float> warped_, mean_, variance_, first_, second_, best_, left_, right_, previous_;
  std::vector<int32_t> plane_;
};

}  // namespace

SE_EXPORT int32_t se_sweep_match(const SeSweep* call) {
  return se::run_guarded([&] {
    se::parallel_for(call->views, 1, call->threads, [&](int64_t begin, int64_t end, int) {
      for (int64_t view = begin; view < end; ++view) {
        const int64_t first = call->start[view], last = call->start[view + 1];
        if (call->planes[2 * view + 1] == 0.0) {
          std::fill(call->inverse + first, call->inverse + last, 0.f), std::fill(call->score + first, call->score + last, -1.f);
        } else {
          Sweep(*call, view).run();
        }
      }
    });
  });
}
