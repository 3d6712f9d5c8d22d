// L1 + SSIM of two images [H, W, 3] and the gradient of their weighted sum, in one pass over bands of rows.
//
// SSIM uses an 11 x 11 Gaussian window of sigma 1.5 (Wang et al. 2004) and zero padding like 3DGS. It is
// computed from the sum s = x + y - 1 and the difference d = x - y of the pixels: then 1 - S is a sum of small
// positive parts, and float32 stays exact where the images agree. With the means ms, md and the variances vs, vd
// of a window, and m = ms + 1:
//   1 - S = p + q - p q,  p = md^2 / B1,  q = vd / B2,  B1 = (m^2 + md^2) / 2 + C1,  B2 = (vs + vd) / 2 + C2.
// The second moments E[ss], E[dd] are the other two filtered maps. The gradient, with the same (symmetric)
// window G, a = (1 - p) / B2 and b = (1 - q) / B1:
//   dS/dx(pixel) = G * P + s (G * Q) - d (G * R),  Q = a q,  R = a (2 - q),  P = m b p - ms Q + md (R - b (2 - p)).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"
#include "status.h"

namespace {

using namespace se;

constexpr int TAPS = 11, RADIUS = 5, BAND = 48;
constexpr int EDGE = 3 * RADIUS;   // neighbours of one channel are 3 floats apart in an interleaved row
constexpr int MARGIN = EDGE + 16;  // room for a whole register beyond the last value
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;

struct Window {
  float w[TAPS];
  Window() {
    double sum = 0, value[TAPS];
    for (int i = 0; i < TAPS; ++i) sum += value[i] = std::exp(-(i - RADIUS) * (i - RADIUS) / (2 * 1.5 * 1.5));
    for (int i = 0; i < TAPS; ++i) w[i] = static_cast<float>(value[i] / sum);
  }
};

struct Picture {
  const float *x, *y;  // [H, W, 3]
  int64_t H, row;      // row = 3 W floats
  float weight_l1, weight_ssim;
  float* gradient;  // [H, W, 3] or null
};

// Workspace of one worker: rows of `length` floats with MARGIN on both sides.
class Scratch {
 public:
  explicit Scratch(int64_t row) : length_(row + 2 * MARGIN), data_((4 + 3 + 3 * TAPS + 2 * TAPS) * length_, 0.f) {}
  float* filtered(int map) { return at(map); }
  float* partial(int map) { return at(4 + map); }
  float* ring(int map, int64_t r) { return at(7 + map * TAPS + static_cast<int>((r % TAPS + TAPS) % TAPS)); }
  float* pixels(int picture, int slot) { return at(7 + 3 * TAPS + picture * TAPS + slot); }
  int64_t length() const { return length_; }

 private:
  float* at(int index) { return data_.data() + index * length_ + MARGIN; }
  int64_t length_;
  std::vector<float> data_;
};

class Band {
 public:
  Band(const Picture& p, Scratch& s) : p_(p), s_(s) {}

  // Process rows [begin, end): add the sums of |x - y| and of 1 - S to sums[0] and sums[1] and write the
  // gradient.
  void run(int64_t begin, int64_t end, double* sums) {
    const int64_t first = p_.gradient ? begin - RADIUS : begin, last = p_.gradient ? end + RADIUS : end;
    for (int64_t r = first - RADIUS; r < first + RADIUS; ++r) load_row(r);
    for (int64_t r = first; r < last; ++r) {
      load_row(r + RADIUS);
      const bool inside = r >= 0 && r < p_.H;
      if (inside) {
        filter_columns(r);
        const double total = compute_dissimilarity();
        if (r >= begin && r < end) sums[1] += total;
      }
      if (!p_.gradient) continue;
      inside ? filter_partials(r) : clear_ring(r);
      if (r - RADIUS >= begin) sums[0] += write_gradient(r - RADIUS);
    }
    if (!p_.gradient)
      for (int64_t r = begin; r < end; ++r) sums[0] += sum_difference(r);
  }

 private:
  // Load s and d of row r into the ring of rows; outside of the image x = y = 0.
  void load_row(int64_t r) {
    const int slot = static_cast<int>((r % TAPS + TAPS) % TAPS);
    float *s = s_.pixels(0, slot), *d = s_.pixels(1, slot);
    if (r < 0 || r >= p_.H) {
      std::fill(s, s + p_.row, -1.f);
      std::fill(d, d + p_.row, 0.f);
      return;
    }
    const float *x = p_.x + r * p_.row, *y = p_.y + r * p_.row;
    for (int64_t i = 0; i < p_.row; ++i) s[i] = x[i] + y[i] - 1.f;
    for (int64_t i = 0; i < p_.row; ++i) d[i] = x[i] - y[i];
  }

  // Apply the vertical half of the window at row r: ms, md, E[ss], E[dd], with the values of the padding in the
  // margins.
  void filter_columns(int64_t r) {
    const float *s[TAPS], *d[TAPS];
    for (int t = 0; t < TAPS; ++t) {
      const int slot = static_cast<int>(((r + t - RADIUS) % TAPS + TAPS) % TAPS);
      s[t] = s_.pixels(0, slot), d[t] = s_.pixels(1, slot);
    }
    float *ms = s_.filtered(0), *md = s_.filtered(1), *ss = s_.filtered(2), *dd = s_.filtered(3);
    for (int64_t i = 0; i < p_.row; i += LANES) {
      Vec a = broadcast(0.f), b = a, e = a, f = a;
      for (int t = 0; t < TAPS; ++t) {
        const Vec w = broadcast(window_.w[t]), u = load(s[t] + i), v = load(d[t] + i), wu = w * u, wv = w * v;
        a = a + wu;
        b = b + wv;
        e = fma(wu, u, e);
        f = fma(wv, v, f);
      }
      store(ms + i, a);
      store(md + i, b);
      store(ss + i, e);
      store(dd + i, f);
    }
    const float padding[4] = {-1.f, 0.f, 1.f, 0.f};
    for (int map = 0; map < 4; ++map) {
      float* row = s_.filtered(map);
      std::fill(row - EDGE, row, padding[map]);
      std::fill(row + p_.row, row + p_.row + EDGE, padding[map]);
    }
  }

  static Vec filter_row(const float* row, const float* w) {
    Vec a = broadcast(w[RADIUS]) * load(row);
    for (int t = 1; t <= RADIUS; ++t) a = fma(broadcast(w[RADIUS + t]), load(row - 3 * t) + load(row + 3 * t), a);
    return a;
  }

  // Apply the horizontal half of the window: return the row's sum of 1 - S and store P, Q, R.
  double compute_dissimilarity() {
    const float *m0 = s_.filtered(0), *m1 = s_.filtered(1), *m2 = s_.filtered(2), *m3 = s_.filtered(3);
    float *P = s_.partial(0), *Q = s_.partial(1), *R = s_.partial(2);
    const Vec half = broadcast(0.5f), two = broadcast(2.f), one = broadcast(1.f);
    double total = 0;
    Vec sums = broadcast(0.f);
    for (int64_t i = 0; i < p_.row; i += LANES) {
      const Vec ms = filter_row(m0 + i, window_.w), md = filter_row(m1 + i, window_.w), m = ms + one;
      const Vec vd = filter_row(m3 + i, window_.w) - md * md, vs = filter_row(m2 + i, window_.w) - ms * ms;
      const Vec B1 = fma(half, fma(m, m, md * md), broadcast(C1)), B2 = fma(half, vs + vd, broadcast(C2));
      const Vec inverse = one / (B1 * B2), by1 = B2 * inverse, by2 = B1 * inverse;
      const Vec p = md * md * by1, q = vd * by2, S = fma(p, one - q, q);  // S is 1 - S of the formula
      if (p_.gradient) {
        const Vec a = (one - p) * by2, b = (one - q) * by1, aq = a * q, r = a * (two - q);
        store(P + i, fma(m * b, p, fma(md, r - b * (two - p), broadcast(0.f) - ms * aq)));
        store(Q + i, aq);
        store(R + i, r);
      }
      if (i + LANES <= p_.row) {
        sums = sums + S;
      } else {
        float tail[LANES];
        store(tail, S);
        for (int64_t t = i; t < p_.row; ++t) total += tail[t - i];
      }
    }
    return total + sum(sums);
  }

  // Apply the horizontal half of the window to P, Q, R of row r (zero outside of the image), into the ring.
  void filter_partials(int64_t r) {
    for (int map = 0; map < 3; ++map) {
      float* row = s_.partial(map);
      std::fill(row - EDGE, row, 0.f);
      std::fill(row + p_.row, row + p_.row + EDGE, 0.f);
      float* out = s_.ring(map, r);
      for (int64_t i = 0; i < p_.row; i += LANES) store(out + i, filter_row(row + i, window_.w));
    }
  }

  void clear_ring(int64_t r) {
    for (int map = 0; map < 3; ++map) std::fill_n(s_.ring(map, r), p_.row, 0.f);
  }

  // Apply the vertical half of the window around row r and write the gradient of both terms. Return the row's
  // sum of |x - y|.
  double write_gradient(int64_t r) {
    const float* map[3][TAPS];
    for (int m = 0; m < 3; ++m)
      for (int t = 0; t < TAPS; ++t) map[m][t] = s_.ring(m, r + t - RADIUS);
    const float *x = p_.x + r * p_.row, *y = p_.y + r * p_.row;
    float* out = p_.gradient + r * p_.row;
    const double n = static_cast<double>(p_.H) * p_.row;
    const float by_l1 = static_cast<float>(p_.weight_l1 / n), by_ssim = static_cast<float>(-p_.weight_ssim / n);
    double total = 0;
    Vec sums = broadcast(0.f);
    for (int64_t i = 0; i < p_.row; i += LANES) {
      Vec g[3];
      for (int m = 0; m < 3; ++m) {
        Vec a = broadcast(0.f);
        for (int t = 0; t < TAPS; ++t) a = fma(broadcast(window_.w[t]), load(map[m][t] + i), a);
        g[m] = a;
      }
      const int64_t left = p_.row - i;
      float tx[LANES] = {}, ty[LANES] = {};
      if (left < LANES) std::copy(x + i, x + p_.row, tx), std::copy(y + i, y + p_.row, ty);
      const Vec u = left < LANES ? load(tx) : load(x + i), v = left < LANES ? load(ty) : load(y + i);
      const Vec d = u - v, zero = broadcast(0.f);
      const Vec sign = select_greater(d, zero, broadcast(by_l1), select_greater(zero, d, broadcast(-by_l1), zero));
      const Vec slope = fma(u + v - broadcast(1.f), g[1], g[0] - d * g[2]);
      const Vec full = fma(broadcast(by_ssim), slope, sign);
      const Vec distance = max(d, zero - d);
      if (left < LANES) {
        store(tx, full), store(ty, distance);
        for (int64_t t = 0; t < left; ++t) out[i + t] = tx[t], total += ty[t];
      } else {
        store(out + i, full);
        sums = sums + distance;
      }
    }
    return total + sum(sums);
  }

  double sum_difference(int64_t r) const {
    double total = 0;
    for (int64_t i = r * p_.row; i < (r + 1) * p_.row; ++i) total += std::fabs(p_.x[i] - p_.y[i]);
    return total;
  }

  const Picture& p_;
  Scratch& s_;
  const Window window_;
};

}  // namespace

SE_EXPORT int32_t se_photometric_loss(const float* x, const float* y, int64_t H, int64_t W, float weight_l1, float weight_ssim, int threads,
                                      float* gradient, double* out) {
  return run_guarded([&] {
    const Picture picture{x, y, H, 3 * W, weight_l1, weight_ssim, gradient};
    const int64_t bands = (H + BAND - 1) / BAND;
    std::vector<double> sums(2 * bands, 0.0);
    parallel_for(H, BAND, threads, [&](int64_t begin, int64_t end, int) {
      Scratch scratch(picture.row);
      Band(picture, scratch).run(begin, end, &sums[2 * (begin / BAND)]);
    });
    out[0] = out[1] = 0;
    for (int64_t b = 0; b < bands; ++b) out[0] += sums[2 * b], out[1] += sums[2 * b + 1];
    const double n = static_cast<double>(H) * 3 * W;
    out[0] /= n, out[1] /= n;
  });
}
