// From the sums over pixels back through the projection to the parameters of the Gaussians.
#include <algorithm>
#include <cstring>

#include "pool.h"
#include "raster_project.h"

namespace se::raster {
namespace {

constexpr float kPowerSlope = 1.38629436f;  // 2 ln 2, the factor that kAbsoluteX and kAbsoluteY leave out

// Add up the sums of one visible Gaussian over the workers' rows or over its tiles' slots, always in the same
// order.
F32x16 sum_gradients(const State& s, uint32_t place, int rows) {
  F32x16 sum = broadcast(0.0f);
  if (rows > 0) {
    const int64_t places = s.places();
    for (int r = 0; r < rows; ++r) sum = sum + load(s.sums.data()[r * places + place].x);
    return sum;
  }
  const Rect rect = s.items.data()[place].rect;
  const uint32_t count = static_cast<uint32_t>((rect.x1 - rect.x0) * (rect.y1 - rect.y0));
  const Sums* slot = s.sums.data() + s.slots.data()[place];
  for (uint32_t k = 0; k < count; ++k) sum = sum + load(slot[k].x);
  return sum;
}

struct ProjectionGradient {  // one Gaussian per lane
  F32x16 mean[3], quat[4], scale[3], mean2d[2];

  // adj(C0) u, where C0 is the 2D covariance without blur: the sum over the axes of p (p . u), where p is an axis
  // turned by a right angle. yy u0 - xy u1 would lose the digits of long thin Gaussians.
  static void apply_adjugate(const Projection& p, F32x16 u0, F32x16 u1, F32x16& out0, F32x16& out1) {
    out0 = out1 = broadcast(0.0f);
    for (int k = 0; k < 3; ++k) {
      const F32x16 across = p.b[1][k] * u0 - p.b[0][k] * u1;  // exactly 0 where u is this axis
      out0 = fma(p.b[1][k], across, out0), out1 = fnma(p.b[0][k], across, out1);
    }
  }

  // C^-1 u, where C is the 2D covariance with blur.
  static void apply_inverse(const Projection& p, F32x16 u0, F32x16 u1, F32x16 inv, F32x16& out0, F32x16& out1) {
    apply_adjugate(p, u0, u1, out0, out1);
    out0 = fma(broadcast(kBlur), u0, out0) * inv, out1 = fma(broadcast(kBlur), u1, out1) * inv;
  }

  // d loss / d axis j of the ellipse: C^-1 S C^-1 b, where S holds the second moments of W, plus the part of the
  // antialias factor, 1/2 (ln sharp - ln det) = ln compensation.
  static void differentiate_axis(const Projection& p, const F32x16 (&sum)[16], F32x16 inv, bool antialias, int j, F32x16& d0, F32x16& d1) {
    F32x16 n0, n1;
    apply_adjugate(p, p.b[0][j], p.b[1][j], n0, n1);
    const F32x16 v0 = fma(broadcast(kBlur), p.b[0][j], n0) * inv, v1 = fma(broadcast(kBlur), p.b[1][j], n1) * inv;
    apply_inverse(p, fma(sum[kSxx], v0, sum[kSxy] * v1), fma(sum[kSxy], v0, sum[kSyy] * v1), inv, d0, d1);
    if (!antialias) return;
    const Mask16 smooth = gt(p.sharp, p.det * broadcast(kMinCompensation2));
    const F32x16 g = keep(smooth, sum[kS]), one_sharp = broadcast(1.0f) / select(smooth, p.sharp, broadcast(1.0f));
    d0 = fma(g, fma(n0, one_sharp, broadcast(0.0f) - v0), d0), d1 = fma(g, fma(n1, one_sharp, broadcast(0.0f) - v1), d1);
  }

  static void differentiate_quaternion(const F32x16 (&q)[4], const F32x16 (&d)[3][3], F32x16 (&out)[4]) {
    const F32x16 w = q[0], x = q[1], y = q[2], z = q[3], two = broadcast(2.0f);
    const F32x16 a = d[2][1] - d[1][2], b = d[0][2] - d[2][0], c = d[1][0] - d[0][1];
    const F32x16 e = d[0][1] + d[1][0], f = d[0][2] + d[2][0], g = d[1][2] + d[2][1];
    out[0] = two * fma(x, a, fma(y, b, z * c));
    out[1] = two * (fma(w, a, fma(y, e, z * f)) - two * x * (d[1][1] + d[2][2]));
    out[2] = two * (fma(w, b, fma(x, e, z * g)) - two * y * (d[0][0] + d[2][2]));
    out[3] = two * (fma(w, c, fma(x, f, y * g)) - two * z * (d[0][0] + d[1][1]));
  }

  ProjectionGradient(const State& s, const Projection& p, const F32x16 (&q)[4], const F32x16 (&size)[3], const F32x16 (&sum)[16]) {
    const SeCamera& cam = s.camera;
    const F32x16 zero = broadcast(0.0f), inv = broadcast(1.0f) / p.det;
    F32x16 gu, gv;
    apply_inverse(p, zero - sum[kSx], zero - sum[kSy], inv, gu, gv);
    mean2d[0] = gu * broadcast(0.5f * static_cast<float>(cam.width)), mean2d[1] = gv * broadcast(0.5f * static_cast<float>(cam.height));
    const Rotation rotation(q);
    F32x16 d_rotation[3][3], d_t[2][3], d_a[2][3];
    for (int j = 0; j < 3; ++j) {
      F32x16 b0, b1;
      differentiate_axis(p, sum, inv, s.antialias, j, b0, b1);
      scale[j] = fma(b0, p.a[0][j], b1 * p.a[1][j]);
      d_a[0][j] = b0 * size[j], d_a[1][j] = b1 * size[j];
      for (int k = 0; k < 3; ++k) d_rotation[k][j] = fma(p.t[0][k], d_a[0][j], p.t[1][k] * d_a[1][j]);
    }
    for (int i = 0; i < 2; ++i)
      for (int k = 0; k < 3; ++k)
        d_t[i][k] = fma(d_a[i][0], rotation.r[k][0], fma(d_a[i][1], rotation.r[k][1], d_a[i][2] * rotation.r[k][2]));
    differentiate_quaternion(q, d_rotation, quat);

    // t[0][k] = fx / z (R0k - tx R2k), t[1][k] = fy / z (R1k - ty R2k); u = fx x / z + cx; the depth is z.
    const F32x16 fx = broadcast(cam.fx), fy = broadcast(cam.fy);
    F32x16 jx = zero, jy = zero, dtx = zero, dty = zero;
    for (int k = 0; k < 3; ++k) {
      const F32x16 r2 = broadcast(cam.view[8 + k]);
      jx = fma(d_t[0][k], fnma(p.tx, r2, broadcast(cam.view[k])), jx);
      jy = fma(d_t[1][k], fnma(p.ty, r2, broadcast(cam.view[4 + k])), jy);
      dtx = fma(d_t[0][k], r2, dtx), dty = fma(d_t[1][k], r2, dty);
    }
    const F32x16 gx = fx * (gu - keep(p.free_x, p.rz * dtx)), gy = fy * (gv - keep(p.free_y, p.rz * dty));  // d / d (x / z), d / d (y / z)
    const F32x16 dx = gx * p.rz, dy = gy * p.rz;
    const F32x16 dz = sum[kDepth] - p.rz * (fma(dx, p.vx, dy * p.vy) + p.rz * fma(fx, jx, fy * jy));
    for (int k = 0; k < 3; ++k)
      mean[k] = fma(broadcast(cam.view[k]), dx, fma(broadcast(cam.view[4 + k]), dy, broadcast(cam.view[8 + k]) * dz));
  }
};

void zero_rows(const Gradients& out, int64_t i, int count) {
  const auto clear = [&](float* p, int width) { std::memset(p + i * width, 0, static_cast<size_t>(count * width) * sizeof(float)); };
  clear(out.means, 3), clear(out.quats, 4), clear(out.scales, 3), clear(out.opacities, 1), clear(out.colors, 3), clear(out.mean2d, 2);
}

void differentiate_group(const State& s, const Inputs& in, const Gradients& out, int rows, int64_t i, int count, uint32_t drawn) {
  F32x16 sum[16];
  uint32_t place = s.group_first.data()[i / 16];
  for (int k = 0; k < 16; ++k) sum[k] = drawn >> k & 1 ? sum_gradients(s, place++, rows) : broadcast(0.0f);
  transpose(sum);
  for (const int k : {kSx, kSy}) sum[k] = sum[k] * broadcast(0.5f);  // from half pixels
  for (const int k : {kSxx, kSxy, kSyy}) sum[k] = sum[k] * broadcast(0.25f);
  F32x16 mean[3], quat[4], scale[3], opacity[1];
  load_columns(in.means + 3 * i, count, mean);
  load_columns(in.quats + 4 * i, count, quat);
  load_columns(in.scales + 3 * i, count, scale);
  load_columns(in.opacities + i, count, opacity);
  Projection p;
  p.project_centre(s.camera, mean);
  p.project_shape(quat, scale);
  const ProjectionGradient gradient(s, p, quat, scale, sum);
  // Lanes that are not drawn may hold any value (a point behind the camera, NaN): set them to 0.
  alignas(64) float flags[16];
  for (int k = 0; k < 16; ++k) flags[k] = drawn >> k & 1 ? 1.0f : 0.0f;
  const Mask16 ok = gt(load(flags), broadcast(0.0f));
  const auto put = [&](float* to, auto columns) {
    for (auto& column : columns.c) column = keep(ok, column);
    store_columns(to, count, columns.c);
  };
  struct C1 {
    F32x16 c[1];
  };
  struct C2 {
    F32x16 c[2];
  };
  struct C3 {
    F32x16 c[3];
  };
  struct C4 {
    F32x16 c[4];
  };
  put(out.means + 3 * i, C3{{gradient.mean[0], gradient.mean[1], gradient.mean[2]}});
  put(out.quats + 4 * i, C4{{gradient.quat[0], gradient.quat[1], gradient.quat[2], gradient.quat[3]}});
  put(out.scales + 3 * i, C3{{gradient.scale[0], gradient.scale[1], gradient.scale[2]}});
  put(out.opacities + i, C1{{sum[kS] / opacity[0]}});
  put(out.colors + 3 * i, C3{{sum[kRed], sum[kGreen], sum[kBlue]}});
  if (out.absolute) {
    const F32x16 x = broadcast(kPowerSlope * 0.5f * static_cast<float>(s.camera.width));
    const F32x16 y = broadcast(kPowerSlope * 0.5f * static_cast<float>(s.camera.height));
    put(out.mean2d + 2 * i, C2{{sum[kAbsoluteX] * x, sum[kAbsoluteY] * y}});
  } else {
    put(out.mean2d + 2 * i, C2{{gradient.mean2d[0], gradient.mean2d[1]}});
  }
}

}  // namespace

void project_backward(State& s, const Inputs& in, const Gradients& out, int rows, int threads) {
  parallel_for(s.m, kChunk, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t i = begin; i < end; i += 16) {
      const int count = static_cast<int>(std::min<int64_t>(16, end - i));
      const uint32_t drawn = s.group_mask.data()[i / 16];
      if (drawn)
        differentiate_group(s, in, out, rows, i, count, drawn);
      else
        zero_rows(out, i, count);
    }
  });
}

}  // namespace se::raster
