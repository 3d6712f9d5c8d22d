// What the parts of the plane sweep share: the cameras of the views.
#pragma once
#include <cmath>
#include <cstdint>

#include "se_api.h"

namespace se {

// A pinhole camera: world to camera [R | t] and the focal lengths and principal point in pixels.
struct SweepCamera {
  double R[9], t[3], fx, fy, cx, cy;
  int32_t width, height;

  SweepCamera(const SeSweep& call, int64_t view) {
    const double* c = call.camera + 16 * view;
    for (int row = 0; row < 3; ++row) {
      for (int column = 0; column < 3; ++column) R[3 * row + column] = c[4 * row + column];
      t[row] = c[4 * row + 3];
    }
    fx = c[12], fy = c[13], cx = c[14], cy = c[15];
    width = call.size[2 * view], height = call.size[2 * view + 1];
  }

  // out [3] = R x + t
  void to_camera(const double* x, double* out) const {
    for (int i = 0; i < 3; ++i) out[i] = R[3 * i] * x[0] + R[3 * i + 1] * x[1] + R[3 * i + 2] * x[2] + t[i];
  }

  // out [3] = the world point of camera point x
  void to_world(const double* x, double* out) const {
    const double a = x[0] - t[0], b = x[1] - t[1], c = x[2] - t[2];
    for (int i = 0; i < 3; ++i) out[i] = R[i] * a + R[3 + i] * b + R[6 + i] * c;
  }

  // Return the number of the pixel that shows camera point x, or -1 if none does.
  int64_t pixel_of(const double* x) const {
    if (!(x[2] > 0)) return -1;
    const double u = fx * x[0] / x[2] + cx, v = fy * x[1] / x[2] + cy;
    if (!(u >= 0 && v >= 0 && u < width && v < height)) return -1;
    return static_cast<int64_t>(v) * width + static_cast<int64_t>(u);
  }
};

}  // namespace se
