// A scalar peer of the CPU rasteriser for benchmarks: the per-pixel algorithm of 3DGS (Kerbl et al. 2023, section 6 and appendix) as
// published, pixel by pixel, in plain C++ that the compiler optimises (-O3 -march=native), on one thread. It uses 3 sigma squares of
// 16 x 16 tiles, one radix sort of (tile, depth) keys, front-to-back blending, and a back-to-front backward pass that recovers T by
// division. The code is our own. Its conventions are those of src/scene_experts/render/reference.py: pixel centres at +0.5, and no
// gradient where alpha is clamped.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "se_api.h"

namespace {

constexpr int kTile = 16;
// exp of smaller values is below 1/255 for any opacity. The published kernel does not skip them; skipping halves the time of the peer.
constexpr float kFaint = -5.55f;

using Camera = SeCamera;

struct Splat {
  float u, v, a, b, c, opacity, color[3], z, cov[3];
  int x0, y0, x1, y1;
};

struct Geometry {  // intermediate values of the projection of one Gaussian, for the forward and the backward pass
  float p[3], tx, ty, R[9], J[6], T[6], B[6], A[6];
  bool free_x, free_y;
};

void rotation(const float* q, float* R) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  const float r[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                      2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                      2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
  std::memcpy(R, r, sizeof r);
}

bool geometry(const Camera& cam, const float* mean, const float* quat, const float* scale, Geometry& g) {
  for (int i = 0; i < 3; ++i)
    g.p[i] = cam.view[4 * i] * mean[0] + cam.view[4 * i + 1] * mean[1] + cam.view[4 * i + 2] * mean[2] + cam.view[4 * i + 3];
  const float z = g.p[2];
  if (!(z > cam.near_plane)) return false;
  const float mx = 0.15f * static_cast<float>(cam.width) / cam.fx, my = 0.15f * static_cast<float>(cam.height) / cam.fy;
  const float x = g.p[0] / z, y = g.p[1] / z;
  g.tx = std::min(std::max(x, -cam.cx / cam.fx - mx), (static_cast<float>(cam.width) - cam.cx) / cam.fx + mx);
  g.ty = std::min(std::max(y, -cam.cy / cam.fy - my), (static_cast<float>(cam.height) - cam.cy) / cam.fy + my);
  g.free_x = g.tx == x, g.free_y = g.ty == y;
  const float J[6] = {cam.fx / z, 0, -cam.fx * g.tx / z, 0, cam.fy / z, -cam.fy * g.ty / z};
  std::memcpy(g.J, J, sizeof J);
  rotation(quat, g.R);
  for (int i = 0; i < 2; ++i) {
    for (int j = 0; j < 3; ++j)
      g.T[3 * i + j] = J[3 * i] * cam.view[j] + J[3 * i + 1] * cam.view[4 + j] + J[3 * i + 2] * cam.view[8 + j];
    for (int j = 0; j < 3; ++j) {
      g.A[3 * i + j] = g.T[3 * i] * g.R[j] + g.T[3 * i + 1] * g.R[3 + j] + g.T[3 * i + 2] * g.R[6 + j];
      g.B[3 * i + j] = g.A[3 * i + j] * scale[j];
    }
  }
  return true;
}

struct Peer {
  std::vector<Splat> splats;
  std::vector<uint8_t> drawn;
  std::vector<uint64_t> keys, keys2;
  std::vector<uint32_t> ids, ids2, begin, last;
  std::vector<float> through;
  int64_t composited = 0;
};

void sort_pairs(Peer& s, int bits) {
  const size_t n = s.keys.size();
  s.keys2.resize(n), s.ids2.resize(n);
  for (int shift = 0; shift < bits; shift += 8) {
    size_t count[257] = {};
    for (size_t i = 0; i < n; ++i) ++count[(s.keys[i] >> shift & 255) + 1];
    for (int d = 0; d < 256; ++d) count[d + 1] += count[d];
    for (size_t i = 0; i < n; ++i) {
      const size_t to = count[s.keys[i] >> shift & 255]++;
      s.keys2[to] = s.keys[i], s.ids2[to] = s.ids[i];
    }
    s.keys.swap(s.keys2), s.ids.swap(s.ids2);
  }
}

// Tile by tile like the thread blocks of the published kernel, so that the Gaussians of a tile stay in the cache.
template <class F>
void each_pixel(const Camera& cam, F&& f) {
  for (int y = 0; y < cam.height; y += kTile)
    for (int x = 0; x < cam.width; x += kTile)
      for (int j = y; j < std::min(y + kTile, cam.height); ++j)
        for (int i = x; i < std::min(x + kTile, cam.width); ++i) f(i, j);
}

}  // namespace

extern "C" void* peer_new() { return new Peer; }
extern "C" void peer_free(void* p) { delete static_cast<Peer*>(p); }
extern "C" int64_t peer_composited(void* p) { return static_cast<Peer*>(p)->composited; }

extern "C" void peer_forward(void* state, const Camera* camera, int64_t m, const float* means, const float* quats, const float* scales,
                             const float* opacities, const float* colors, const float* background, float* image) {
  Peer& s = *static_cast<Peer*>(state);
  const Camera& cam = *camera;
  const int nx = (cam.width + kTile - 1) / kTile, ny = (cam.height + kTile - 1) / kTile;
  s.splats.resize(m), s.drawn.assign(m, 0), s.keys.clear(), s.ids.clear();
  for (int64_t i = 0; i < m; ++i) {
    Geometry g;
    if (!geometry(cam, means + 3 * i, quats + 4 * i, scales + 3 * i, g)) continue;
    float xx = 0.3f, xy = 0, yy = 0.3f;
    for (int k = 0; k < 3; ++k) xx += g.B[k] * g.B[k], xy += g.B[k] * g.B[3 + k], yy += g.B[3 + k] * g.B[3 + k];
    const float det = xx * yy - xy * xy;
    if (!(det > 0)) continue;
    Splat& p = s.splats[i];
    p = {cam.fx * g.p[0] / g.p[2] + cam.cx, cam.fy * g.p[1] / g.p[2] + cam.cy, yy / det, -xy / det, xx / det, opacities[i],
         {colors[3 * i], colors[3 * i + 1], colors[3 * i + 2]}, g.p[2], {xx, xy, yy}, 0, 0, 0, 0};
    const float mid = 0.5f * (xx + yy), radius = std::ceil(3 * std::sqrt(mid + std::sqrt(std::max(0.1f, mid * mid - det))));
    const auto clamp = [](float t, int n) { return std::min(n, std::max(0, static_cast<int>(std::min(1e6f, std::max(-1e6f, t))))); };
    p.x0 = clamp((p.u - radius) / kTile, nx), p.x1 = clamp((p.u + radius + kTile - 1) / kTile, nx);
    p.y0 = clamp((p.v - radius) / kTile, ny), p.y1 = clamp((p.v + radius + kTile - 1) / kTile, ny);
    if (p.x0 >= p.x1 || p.y0 >= p.y1) continue;
    s.drawn[i] = 1;
    uint32_t depth;
    std::memcpy(&depth, &p.z, 4);
    for (int y = p.y0; y < p.y1; ++y)
      for (int x = p.x0; x < p.x1; ++x) {
        s.keys.push_back(static_cast<uint64_t>(y * nx + x) << 32 | depth);
        s.ids.push_back(static_cast<uint32_t>(i));
      }
  }
  int bits = 32;
  while ((nx * ny) >> (bits - 32)) ++bits;
  sort_pairs(s, bits);
  s.begin.assign(nx * ny + 1, 0);
  for (const uint64_t key : s.keys) ++s.begin[(key >> 32) + 1];
  for (int t = 0; t < nx * ny; ++t) s.begin[t + 1] += s.begin[t];
  s.last.resize(cam.width * cam.height), s.through.resize(cam.width * cam.height);
  s.composited = 0;
  each_pixel(cam, [&](int i, int j) {
      const int tile = j / kTile * nx + i / kTile, pixel = j * cam.width + i;
      const float x = static_cast<float>(i) + 0.5f, y = static_cast<float>(j) + 0.5f;
      float T = 1, c[3] = {0, 0, 0};
      uint32_t last = s.begin[tile];
      for (uint32_t k = s.begin[tile]; k < s.begin[tile + 1]; ++k) {
        const Splat& p = s.splats[s.ids[k]];
        const float dx = p.u - x, dy = p.v - y;
        const float power = -0.5f * (p.a * dx * dx + p.c * dy * dy) - p.b * dx * dy;
        if (power > 0 || power < kFaint) continue;
        const float alpha = std::min(0.99f, p.opacity * std::exp(power));
        if (alpha < 1.0f / 255) continue;
        const float next = T * (1 - alpha);
        if (next < 1e-4f) break;
        for (int d = 0; d < 3; ++d) c[d] += p.color[d] * alpha * T;
        T = next;
        last = k + 1;
        ++s.composited;
      }
      s.last[pixel] = last, s.through[pixel] = T;
      for (int d = 0; d < 3; ++d) image[3 * pixel + d] = c[d] + T * background[d];
  });
}

extern "C" void peer_backward(void* state, const Camera* camera, int64_t m, const float* means, const float* quats, const float* scales,
                              const float* background, const float* g_image, float* d_means, float* d_quats, float* d_scales,
                              float* d_opacities, float* d_colors) {
  Peer& s = *static_cast<Peer*>(state);
  const Camera& cam = *camera;
  const int nx = (cam.width + kTile - 1) / kTile;
  std::vector<float> d_uv(2 * m, 0.0f), d_conic(3 * m, 0.0f);
  std::fill(d_opacities, d_opacities + m, 0.0f);
  std::fill(d_colors, d_colors + 3 * m, 0.0f);
  each_pixel(cam, [&](int i, int j) {
      const int tile = j / kTile * nx + i / kTile, pixel = j * cam.width + i;
      const float x = static_cast<float>(i) + 0.5f, y = static_cast<float>(j) + 0.5f;
      const float* g = g_image + 3 * pixel;
      float T = s.through[pixel], behind[3] = {background[0], background[1], background[2]};
      for (uint32_t k = s.last[pixel]; k-- > s.begin[tile];) {
        const uint32_t id = s.ids[k];
        const Splat& p = s.splats[id];
        const float dx = p.u - x, dy = p.v - y;
        const float power = -0.5f * (p.a * dx * dx + p.c * dy * dy) - p.b * dx * dy;
        if (power > 0 || power < kFaint) continue;
        const float G = std::exp(power), raw = p.opacity * G, alpha = std::min(0.99f, raw);
        if (alpha < 1.0f / 255) continue;
        T /= 1 - alpha;
        float d_alpha = 0;
        for (int d = 0; d < 3; ++d) {
          d_alpha += (p.color[d] - behind[d]) * g[d];
          d_colors[3 * id + d] += alpha * T * g[d];
          behind[d] = alpha * p.color[d] + (1 - alpha) * behind[d];
        }
        d_alpha *= T;
        if (raw > 0.99f) continue;
        d_opacities[id] += G * d_alpha;
        const float d_power = raw * d_alpha;
        d_uv[2 * id] -= d_power * (p.a * dx + p.b * dy);
        d_uv[2 * id + 1] -= d_power * (p.b * dx + p.c * dy);
        d_conic[3 * id] -= 0.5f * d_power * dx * dx;
        d_conic[3 * id + 1] -= 0.5f * d_power * dx * dy;
        d_conic[3 * id + 2] -= 0.5f * d_power * dy * dy;
      }
  });
  for (int64_t i = 0; i < m; ++i) {
    float *dm = d_means + 3 * i, *dq = d_quats + 4 * i, *ds = d_scales + 3 * i;
    dm[0] = dm[1] = dm[2] = dq[0] = dq[1] = dq[2] = dq[3] = ds[0] = ds[1] = ds[2] = 0;
    if (!s.drawn[i]) continue;
    const Splat& p = s.splats[i];
    Geometry g;
    geometry(cam, means + 3 * i, quats + 4 * i, scales + 3 * i, g);
    const float *q = quats + 4 * i, *scale = scales + 3 * i, *dc = &d_conic[3 * i];
    // d / d cov = -conic (d / d conic) conic
    const float r0 = p.a * dc[0] + p.b * dc[1], r1 = p.a * dc[1] + p.b * dc[2];
    const float q0 = p.b * dc[0] + p.c * dc[1], q1 = p.b * dc[1] + p.c * dc[2];
    const float gxx = -(r0 * p.a + r1 * p.b), gxy = -(r0 * p.b + r1 * p.c), gyy = -(q0 * p.b + q1 * p.c);
    float dA[6], dT[6], dR[9];
    for (int k = 0; k < 3; ++k) {
      const float b0 = 2 * (gxx * g.B[k] + gxy * g.B[3 + k]), b1 = 2 * (gxy * g.B[k] + gyy * g.B[3 + k]);
      ds[k] = b0 * g.A[k] + b1 * g.A[3 + k];
      dA[k] = b0 * scale[k], dA[3 + k] = b1 * scale[k];
    }
    for (int k = 0; k < 3; ++k)
      for (int l = 0; l < 3; ++l) dR[3 * k + l] = g.T[k] * dA[l] + g.T[3 + k] * dA[3 + l];
    for (int r = 0; r < 2; ++r)
      for (int k = 0; k < 3; ++k) dT[3 * r + k] = dA[3 * r] * g.R[3 * k] + dA[3 * r + 1] * g.R[3 * k + 1] + dA[3 * r + 2] * g.R[3 * k + 2];
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    dq[0] = 2 * (x * (dR[7] - dR[5]) + y * (dR[2] - dR[6]) + z * (dR[3] - dR[1]));
    dq[1] = 2 * (w * (dR[7] - dR[5]) + y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) - 2 * x * (dR[4] + dR[8]));
    dq[2] = 2 * (w * (dR[2] - dR[6]) + x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) - 2 * y * (dR[0] + dR[8]));
    dq[3] = 2 * (w * (dR[3] - dR[1]) + x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) - 2 * z * (dR[0] + dR[4]));
    float dJ[6] = {};
    for (int r = 0; r < 2; ++r)
      for (int l = 0; l < 3; ++l)
        for (int k = 0; k < 3; ++k) dJ[3 * r + l] += dT[3 * r + k] * cam.view[4 * l + k];
    const float rz = 1 / g.p[2], du = d_uv[2 * i], dv = d_uv[2 * i + 1];
    float dp[3];
    dp[0] = cam.fx * rz * du - (g.free_x ? cam.fx * rz * rz * dJ[2] : 0);
    dp[1] = cam.fy * rz * dv - (g.free_y ? cam.fy * rz * rz * dJ[5] : 0);
    dp[2] = -rz * rz * (cam.fx * (g.p[0] * du + dJ[0] - g.tx * dJ[2]) + cam.fy * (g.p[1] * dv + dJ[4] - g.ty * dJ[5])) +
            rz * rz * rz * (cam.fx * (g.free_x ? g.p[0] * dJ[2] : 0) + cam.fy * (g.free_y ? g.p[1] * dJ[5] : 0));
    for (int k = 0; k < 3; ++k) dm[k] = cam.view[k] * dp[0] + cam.view[4 + k] * dp[1] + cam.view[8 + k] * dp[2];
  }
}
