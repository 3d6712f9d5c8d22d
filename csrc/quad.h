// F32x4: four floats, for one Gaussian's mean, scale, colour or quaternion on every processor. Rows of three
// have a zero as the fourth.
#pragma once
#include <cstring>

namespace se {

typedef float F32x4 __attribute__((vector_size(16)));

inline F32x4 load4(const float* p) {
  F32x4 q;
  std::memcpy(&q, p, 16);
  return q;
}
inline void store4(float* p, F32x4 q) { std::memcpy(p, &q, 16); }
inline F32x4 load3(const float* p) { return F32x4{p[0], p[1], p[2], 0.f}; }
inline void store3(float* p, F32x4 q) {
  std::memcpy(p, &q, 8);
  p[2] = q[2];
}
inline F32x4 broadcast4(float x) { return F32x4{x, x, x, x}; }
inline float dot(F32x4 a, F32x4 b) {
  const F32x4 p = a * b;
  return (p[0] + p[2]) + (p[1] + p[3]);
}

}  // namespace se
