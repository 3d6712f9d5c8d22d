// Noise on the positions of explicit Gaussians (3DGS-MCMC), shaped like each Gaussian and fading with its
// opacity:
//   mean += Sigma eta size sigmoid(-sharpness (opacity - faint)),  Sigma = R S S^T R^T
// Computed for CHUNK Gaussians at a time with Gaussians along the lanes. strategy/mcmc.py has the same in torch.
#include <cstdint>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"

namespace se {
namespace {

constexpr int CHUNK = 256;

struct Noise {
  float* means;
  const float *quats, *log_scales, *raw_opacity, *eta;
  float size, sharpness, faint;
};

// Load rows of `width` values as columns; the lanes beyond `n` repeat the last row.
void load_columns(const float* from, int64_t begin, int n, int width, float to[][CHUNK]) {
  for (int i = 0; i < round_up(n, LANES); ++i)
    for (int k = 0; k < width; ++k) to[k][i] = from[width * (begin + (i < n ? i : n - 1)) + k];
}

void add_noise(const Noise& a, int64_t begin, int64_t end) {
  const int n = static_cast<int>(end - begin);
  alignas(64) float q[4][CHUNK], s[3][CHUNK], o[1][CHUNK], e[3][CHUNK], out[3][CHUNK];
  load_columns(a.quats, begin, n, 4, q);
  load_columns(a.log_scales, begin, n, 3, s);
  load_columns(a.raw_opacity, begin, n, 1, o);
  load_columns(a.eta, begin, n, 3, e);
  const Vec one = broadcast(1.f), two = broadcast(2.f);
  for (int i = 0; i < n; i += LANES) {
    Vec w = load(q[0] + i), x = load(q[1] + i), y = load(q[2] + i), z = load(q[3] + i);
    const Vec inverse = one / max(square_root(w * w + x * x + y * y + z * z), broadcast(1e-12f));
    w = w * inverse, x = x * inverse, y = y * inverse, z = z * inverse;
    const Vec r[3][3] = {{one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)},
                         {two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)},
                         {two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)}};
    const Vec eta[3] = {load(e[0] + i), load(e[1] + i), load(e[2] + i)};
    const Vec gate = sigmoid(broadcast(-a.sharpness) * (sigmoid(load(o[0] + i)) - broadcast(a.faint))) * broadcast(a.size);
    Vec along[3];
    for (int k = 0; k < 3; ++k) {
      const Vec scale = exponential(load(s[k] + i));
      along[k] = (r[0][k] * eta[0] + r[1][k] * eta[1] + r[2][k] * eta[2]) * scale * scale * gate;
    }
    for (int k = 0; k < 3; ++k) store(out[k] + i, r[k][0] * along[0] + r[k][1] * along[1] + r[k][2] * along[2]);
  }
  for (int i = 0; i < n; ++i)
    for (int k = 0; k < 3; ++k) a.means[3 * (begin + i) + k] += out[k][i];
}

}  // namespace
}  // namespace se

// Quaternions may have any length; raw_opacity holds logits; eta has unit variance.
SE_EXPORT void se_mcmc_add_noise(float* means, const float* quats, const float* log_scales, const float* raw_opacity, const float* eta,
                                 int64_t count, float size, float sharpness, float faint, int32_t threads) {
  const se::Noise noise{means, quats, log_scales, raw_opacity, eta, size, sharpness, faint};
  se::parallel_for(count, se::CHUNK, threads, [&](int64_t begin, int64_t end, int) { se::add_noise(noise, begin, end); });
}
