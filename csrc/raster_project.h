// Projection of sixteen Gaussians at once, shared by the forward pass, the backward pass and the visibility
// filter.
#pragma once
#include "raster.h"
#include "raster_simd.h"

namespace se::raster {

constexpr float kBlur = 0.3f;
constexpr float kMinCompensation2 = 2.5e-5f;  // 0.005^2

inline float tiles_to_pixels(int tiles) { return static_cast<float>(tiles * kTile); }

// Load sixteen rows of `Width` floats as columns; rows from `count` on repeat the last one.
template <int Width>
inline void load_columns(const float* rows, int count, F32x16 (&column)[Width]) {
  if (count == 16) {
    if constexpr (Width == 1) {
      column[0] = load(rows);
    } else if constexpr (Width == 3) {
      load3(rows, column[0], column[1], column[2]);
    } else {
      static_assert(Width == 4);
      // Each register holds four rows, one per quarter. Collect quarters of the same index, then transpose rows
      // and columns.
      for (int k = 0; k < 4; ++k) column[k] = load(rows + 16 * k);
      transpose_quarters(column);  // register q: rows q, 4 + q, 8 + q, 12 + q
      transpose4(column);          // register k: column k, quarter j: rows 4 j + 0..3
    }
    return;
  }
  alignas(64) float temporary[Width][16];
  for (int i = 0; i < 16; ++i)
    for (int k = 0; k < Width; ++k) temporary[k][i] = rows[(i < count ? i : count - 1) * Width + k];
  for (int k = 0; k < Width; ++k) column[k] = load(temporary[k]);
}

// Store columns as rows.
template <int Width>
inline void store_columns(float* rows, int count, const F32x16 (&column)[Width]) {
  if (count == 16) {
    F32x16 line[Width];
    for (int k = 0; k < Width; ++k) line[k] = column[k];
    if constexpr (Width == 2) interleave2(line);
    if constexpr (Width == 3) interleave3(line);
    if constexpr (Width == 4) transpose4(line), transpose_quarters(line);
    for (int k = 0; k < Width; ++k) store(rows + 16 * k, line[k]);
    return;
  }
  alignas(64) float temporary[Width][16];
  for (int k = 0; k < Width; ++k) store(temporary[k], column[k]);
  for (int i = 0; i < count; ++i)
    for (int k = 0; k < Width; ++k) rows[i * Width + k] = temporary[k][i];
}

struct Rotation {
  F32x16 r[3][3];
  explicit Rotation(const F32x16 (&q)[4]) {
    const F32x16 w = q[0], x = q[1], y = q[2], z = q[3], one = broadcast(1.0f), two = broadcast(2.0f);
    const F32x16 x2 = x * two, y2 = y * two, z2 = z * two;
    r[0][0] = fnma(y2, y, fnma(z2, z, one)), r[0][1] = x2 * y - w * z2, r[0][2] = fma(x2, z, w * y2);
    r[1][0] = fma(x2, y, w * z2), r[1][1] = fnma(x2, x, fnma(z2, z, one)), r[1][2] = y2 * z - w * x2;
    r[2][0] = x2 * z - w * y2, r[2][1] = fma(y2, z, w * x2), r[2][2] = fnma(x2, x, fnma(y2, y, one));
  }
};

// One Gaussian per lane, from the world to its ellipse in the image.
struct Projection {
  F32x16 vx, vy, vz, rz;     // point in camera coordinates, 1 / z
  F32x16 u, v;               // px
  F32x16 tx, ty;             // x / z and y / z, limited for the Jacobian
  Mask16 free_x, free_y;     // not limited
  F32x16 t[2][3];            // Jacobian times camera rotation
  F32x16 a[2][3], b[2][3];   // t times the Gaussian's rotation; a times scales
  F32x16 xx, xy, yy, sharp;  // 2D covariance without blur, its determinant
  F32x16 cxx, cyy, det;      // with blur
  Mask16 front;

  void project_centre(const SeCamera& c, const F32x16 (&mean)[3]) {
    const auto row = [&](int k) {
      return fma(broadcast(c.view[4 * k]), mean[0],
                 fma(broadcast(c.view[4 * k + 1]), mean[1], fma(broadcast(c.view[4 * k + 2]), mean[2], broadcast(c.view[4 * k + 3]))));
    };
    vx = row(0), vy = row(1), vz = row(2);
    front = gt(vz, broadcast(c.near_plane));
    rz = broadcast(1.0f) / select(front, vz, broadcast(1.0f));
    const F32x16 x = vx * rz, y = vy * rz;
    u = fma(broadcast(c.fx), x, broadcast(c.cx));
    v = fma(broadcast(c.fy), y, broadcast(c.cy));
    const float width = static_cast<float>(c.width), height = static_cast<float>(c.height);
    const float mx = 0.3f * width / (2 * c.fx), my = 0.3f * height / (2 * c.fy);
    const F32x16 lo_x = broadcast(-c.cx / c.fx - mx), hi_x = broadcast((width - c.cx) / c.fx + mx);
    const F32x16 lo_y = broadcast(-c.cy / c.fy - my), hi_y = broadcast((height - c.cy) / c.fy + my);
    free_x = ge(x, lo_x) & ge(hi_x, x), free_y = ge(y, lo_y) & ge(hi_y, y);
    tx = min(max(x, lo_x), hi_x), ty = min(max(y, lo_y), hi_y);
    for (int k = 0; k < 3; ++k) {
      t[0][k] = broadcast(c.fx) * rz * fnma(tx, broadcast(c.view[8 + k]), broadcast(c.view[k]));
      t[1][k] = broadcast(c.fy) * rz * fnma(ty, broadcast(c.view[8 + k]), broadcast(c.view[4 + k]));
    }
  }

  void compute_ellipse(const F32x16 (&scale)[3]) {
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j) b[i][j] = a[i][j] * scale[j];
    xx = fma(b[0][0], b[0][0], fma(b[0][1], b[0][1], b[0][2] * b[0][2]));
    xy = fma(b[0][0], b[1][0], fma(b[0][1], b[1][1], b[0][2] * b[1][2]));
    yy = fma(b[1][0], b[1][0], fma(b[1][1], b[1][1], b[1][2] * b[1][2]));
    // Lagrange's identity: the determinant as a sum of squares, exact for thin Gaussians too.
    const F32x16 m01 = b[0][0] * b[1][1] - b[0][1] * b[1][0], m02 = b[0][0] * b[1][2] - b[0][2] * b[1][0];
    const F32x16 m12 = b[0][1] * b[1][2] - b[0][2] * b[1][1];
    sharp = fma(m01, m01, fma(m02, m02, m12 * m12));
    cxx = xx + broadcast(kBlur), cyy = yy + broadcast(kBlur);
    det = fma(broadcast(kBlur), xx + yy, sharp + broadcast(kBlur * kBlur));
  }

  void project_shape(const F32x16 (&q)[4], const F32x16 (&scale)[3]) {
    const Rotation rotation(q);
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j) a[i][j] = fma(t[i][0], rotation.r[0][j], fma(t[i][1], rotation.r[1][j], t[i][2] * rotation.r[2][j]));
    compute_ellipse(scale);
  }

  void project_unrotated(const F32x16 (&scale)[3]) {
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j) a[i][j] = t[i][j];
    compute_ellipse(scale);
  }

  // The radius of the 3 sigma rule, 0 where it touches no tile. NaN and infinity fail a comparison and give 0.
  F32x16 radius(int tiles_x, int tiles_y) const {
    const F32x16 half = (cxx - cyy) * broadcast(0.5f), zero = broadcast(0.0f);
    const F32x16 spread = sqrt(max(fma(half, half, xy * xy), broadcast(0.1f)));
    const F32x16 r = ceil(broadcast(3.0f) * sqrt((cxx + cyy) * broadcast(0.5f) + spread));
    const Mask16 drawn = front & gt(det, zero) & gt(broadcast(3e38f), r) & gt(broadcast(3e38f), det) & gt(u + r, zero) &
                         gt(broadcast(tiles_to_pixels(tiles_x)), u - r) & gt(v + r, zero) & gt(broadcast(tiles_to_pixels(tiles_y)), v - r);
    return keep(drawn, min(r, broadcast(1073741824.0f)));
  }

  F32x16 compensation2() const { return max(sharp / det, broadcast(kMinCompensation2)); }
};

}  // namespace se::raster
