// Four floats at once: what one Gaussian's mean, scale, colour or quaternion needs on every processor. Rows of three have a zero behind.
#pragma once
#include <cstring>

namespace se {

typedef float Quad __attribute__((vector_size(16)));

inline Quad load4(const float* p) {
  Quad q;
  std::memcpy(&q, p, 16);
  return q;
}
inline void store4(float* p, Quad q) { std::memcpy(p, &q, 16); }
inline Quad load3(const float* p) { return Quad{p[0], p[1], p[2], 0.f}; }
inline void store3(float* p, Quad q) {
  std::memcpy(p, &q, 8);
  p[2] = q[2];
}
inline Quad four(float x) { return Quad{x, x, x, x}; }
inline float dot(Quad a, Quad b) {
  const Quad p = a * b;
  return (p[0] + p[2]) + (p[1] + p[3]);
}

}  // namespace se
