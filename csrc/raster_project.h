// The projection of sixteen Gaussians at once, shared by forward, backward and the visibility filter.
#pragma once
#include "raster.h"
#include "raster_simd.h"

namespace se::raster {

constexpr float kBlur = 0.3f;
constexpr float kMinCompensation2 = 2.5e-5f;  // 0.005^2

inline float edge(int tiles) { return static_cast<float>(tiles * kTile); }

// Reads sixteen rows of `Width` floats as columns; rows from `count` on repeat the last one.
template <int Width>
inline void load_columns(const float* rows, int count, F16 (&column)[Width]) {
  if (count == 16) {
    if constexpr (Width == 1) {
      column[0] = load(rows);
    } else if constexpr (Width == 3) {
      load3(rows, column[0], column[1], column[2]);
    } else {
      static_assert(Width == 4);
      // Four rows to a register, a row to a quarter: quarters become registers of quarters' rows, then rows become columns.
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

// The way back.
template <int Width>
inline void store_columns(float* rows, int count, const F16 (&column)[Width]) {
  if (count == 16) {
    F16 line[Width];
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
  F16 r[3][3];
  explicit Rotation(const F16 (&q)[4]) {
    const F16 w = q[0], x = q[1], y = q[2], z = q[3], one = bcast(1.0f), two = bcast(2.0f);
    const F16 x2 = x * two, y2 = y * two, z2 = z * two;
    r[0][0] = fnma(y2, y, fnma(z2, z, one)), r[0][1] = x2 * y - w * z2, r[0][2] = fma(x2, z, w * y2);
    r[1][0] = fma(x2, y, w * z2), r[1][1] = fnma(x2, x, fnma(z2, z, one)), r[1][2] = y2 * z - w * x2;
    r[2][0] = x2 * z - w * y2, r[2][1] = fma(y2, z, w * x2), r[2][2] = fnma(x2, x, fnma(y2, y, one));
  }
};

// One Gaussian per lane, from the world to its ellipse in the picture.
struct Projection {
  F16 vx, vy, vz, rz;          // camera point, 1 / z
  F16 u, v;                    // px
  F16 tx, ty;                  // x / z and y / z inside the limits of the Jacobian
  M16 free_x, free_y;          // not limited
  F16 t[2][3];                 // Jacobian times camera rotation
  F16 a[2][3], b[2][3];        // t times Gaussian's rotation; times scales
  F16 xx, xy, yy, sharp;       // 2D covariance without blur, its determinant
  F16 cxx, cyy, det;           // with blur
  M16 front;

  void centre(const SeCamera& c, const F16 (&mean)[3]) {
    const auto row = [&](int k) {
      return fma(bcast(c.view[4 * k]), mean[0],
                 fma(bcast(c.view[4 * k + 1]), mean[1], fma(bcast(c.view[4 * k + 2]), mean[2], bcast(c.view[4 * k + 3]))));
    };
    vx = row(0), vy = row(1), vz = row(2);
    front = gt(vz, bcast(c.near_plane));
    rz = bcast(1.0f) / select(front, vz, bcast(1.0f));
    const F16 x = vx * rz, y = vy * rz;
    u = fma(bcast(c.fx), x, bcast(c.cx));
    v = fma(bcast(c.fy), y, bcast(c.cy));
    const float width = static_cast<float>(c.width), height = static_cast<float>(c.height);
    const float mx = 0.3f * width / (2 * c.fx), my = 0.3f * height / (2 * c.fy);
    const F16 lo_x = bcast(-c.cx / c.fx - mx), hi_x = bcast((width - c.cx) / c.fx + mx);
    const F16 lo_y = bcast(-c.cy / c.fy - my), hi_y = bcast((height - c.cy) / c.fy + my);
    free_x = ge(x, lo_x) & ge(hi_x, x), free_y = ge(y, lo_y) & ge(hi_y, y);
    tx = min(max(x, lo_x), hi_x), ty = min(max(y, lo_y), hi_y);
    for (int k = 0; k < 3; ++k) {
      t[0][k] = bcast(c.fx) * rz * fnma(tx, bcast(c.view[8 + k]), bcast(c.view[k]));
      t[1][k] = bcast(c.fy) * rz * fnma(ty, bcast(c.view[8 + k]), bcast(c.view[4 + k]));
    }
  }

  void ellipse(const F16 (&scale)[3]) {
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j) b[i][j] = a[i][j] * scale[j];
    xx = fma(b[0][0], b[0][0], fma(b[0][1], b[0][1], b[0][2] * b[0][2]));
    xy = fma(b[0][0], b[1][0], fma(b[0][1], b[1][1], b[0][2] * b[1][2]));
    yy = fma(b[1][0], b[1][0], fma(b[1][1], b[1][1], b[1][2] * b[1][2]));
    // Lagrange's identity: the determinant as a sum of squares, exact for thin Gaussians too.
    const F16 m01 = b[0][0] * b[1][1] - b[0][1] * b[1][0], m02 = b[0][0] * b[1][2] - b[0][2] * b[1][0];
    const F16 m12 = b[0][1] * b[1][2] - b[0][2] * b[1][1];
    sharp = fma(m01, m01, fma(m02, m02, m12 * m12));
    cxx = xx + bcast(kBlur), cyy = yy + bcast(kBlur);
    det = fma(bcast(kBlur), xx + yy, sharp + bcast(kBlur * kBlur));
  }

  void shape(const F16 (&q)[4], const F16 (&scale)[3]) {
    const Rotation rotation(q);
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j)
        a[i][j] = fma(t[i][0], rotation.r[0][j], fma(t[i][1], rotation.r[1][j], t[i][2] * rotation.r[2][j]));
    ellipse(scale);
  }

  void shape_unrotated(const F16 (&scale)[3]) {
    for (int i = 0; i < 2; ++i)
      for (int j = 0; j < 3; ++j) a[i][j] = t[i][j];
    ellipse(scale);
  }

  // The radius of the 3 sigma rule, 0 where it meets no tile; NaN and infinity fail a comparison and give 0.
  F16 radius(int tiles_x, int tiles_y) const {
    const F16 half = (cxx - cyy) * bcast(0.5f), zero = bcast(0.0f);
    const F16 spread = sqrt(max(fma(half, half, xy * xy), bcast(0.1f)));
    const F16 r = ceil(bcast(3.0f) * sqrt((cxx + cyy) * bcast(0.5f) + spread));
    const M16 drawn = front & gt(det, zero) & gt(bcast(3e38f), r) & gt(bcast(3e38f), det) & gt(u + r, zero) &
                      gt(bcast(edge(tiles_x)), u - r) & gt(v + r, zero) & gt(bcast(edge(tiles_y)), v - r);
    return keep(drawn, min(r, bcast(1073741824.0f)));
  }

  F16 compensation2() const { return max(sharp / det, bcast(kMinCompensation2)); }
};

}  // namespace se::raster
