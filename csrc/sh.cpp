// Colours of Gaussians from real spherical harmonics of degree 0 to 3, forward and backward; geometry/sh.py has
// the same in torch. Computed for CHUNK Gaussians at a time with Gaussians along the lanes: transposing the
// coefficients once costs less than sums over lanes.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "lanes.h"
#include "pool.h"
#include "se_api.h"

namespace se {
namespace {

constexpr int CHUNK = 64, MOST = 16;  // MOST: coefficients per channel at degree 3
constexpr float C0 = 0.28209479177387814f, C1 = 0.4886025119029199f;
constexpr float D0 = 1.0925484305920792f, D2 = 0.31539156525252005f, D4 = 0.5462742152960396f;  // D1 = D3 = -D0
constexpr float E0 = -0.5900435899266435f, E1 = 2.890611442640554f, E2 = -0.4570457994644658f, E3 = 0.3731763325901154f,
                E5 = 1.445305721320277f;  // E4 = E2, E6 = E0

// The arguments of a call; see se_api.h.
struct Harmonics {
  const float *means, *dc, *rest;
  const int64_t* rows;
  int64_t width;  // coefficients per channel in `rest`
  int degree;
  const float* position;

  int64_t row(int64_t i) const { return rows ? rows[i] : i; }
  int used() const { return (degree + 1) * (degree + 1); }
};

// One chunk: unit directions and the inverse of their length, the basis functions, and the transposed
// coefficients.
struct Chunk {
  alignas(64) float x[CHUNK], y[CHUNK], z[CHUNK], inverse[CHUNK];
  alignas(64) float basis[MOST * CHUNK];
  alignas(64) float coefficients[3 * MOST * CHUNK];  // [coefficient][channel][CHUNK]
};

void gather(const Harmonics& h, int64_t begin, int64_t end, Chunk& c) {
  const int n = static_cast<int>(end - begin), used = 3 * (h.used() - 1);
  for (int i = 0; i < n; ++i) {
    const float* mean = h.means + 3 * (begin + i);
    c.x[i] = mean[0] - h.position[0];
    c.y[i] = mean[1] - h.position[1];
    c.z[i] = mean[2] - h.position[2];
    const int64_t row = h.row(begin + i);
    const float *dc = h.dc + 3 * row, *rest = h.rest + 3 * h.width * row;
    for (int k = 0; k < 3; ++k) c.coefficients[k * CHUNK + i] = dc[k];
    for (int k = 0; k < used; ++k) c.coefficients[(3 + k) * CHUNK + i] = rest[k];
  }
  for (int i = n; i < round_up(n, LANES); ++i) {  // fill whole registers: these lanes are computed and discarded
    c.x[i] = c.y[i] = c.z[i] = 1.f;
    for (int k = 0; k < used + 3; ++k) c.coefficients[k * CHUNK + i] = 0.f;
  }
}

void evaluate_basis(int degree, int n, Chunk& c) {
  for (int i = 0; i < n; i += LANES) {
    Vec x = load(c.x + i), y = load(c.y + i), z = load(c.z + i);
    const Vec inverse = broadcast(1.f) / max(square_root(fma(x, x, fma(y, y, z * z))), broadcast(1e-12f));
    x = x * inverse, y = y * inverse, z = z * inverse;
    store(c.x + i, x), store(c.y + i, y), store(c.z + i, z), store(c.inverse + i, inverse);
    float* b = c.basis + i;
    store(b, broadcast(C0));
    if (degree < 1) continue;
    store(b + 1 * CHUNK, broadcast(-C1) * y), store(b + 2 * CHUNK, broadcast(C1) * z), store(b + 3 * CHUNK, broadcast(-C1) * x);
    if (degree < 2) continue;
    const Vec xx = x * x, yy = y * y, zz = z * z, xy = x * y;
    store(b + 4 * CHUNK, broadcast(D0) * xy), store(b + 5 * CHUNK, broadcast(-D0) * (y * z));
    store(b + 6 * CHUNK, broadcast(D2) * (zz + zz - xx - yy));
    store(b + 7 * CHUNK, broadcast(-D0) * (x * z)), store(b + 8 * CHUNK, broadcast(D4) * (xx - yy));
    if (degree < 3) continue;
    const Vec four = broadcast(4.f) * zz - xx - yy, three = broadcast(3.f);
    store(b + 9 * CHUNK, broadcast(E0) * y * (three * xx - yy)), store(b + 10 * CHUNK, broadcast(E1) * xy * z);
    store(b + 11 * CHUNK, broadcast(E2) * y * four), store(b + 12 * CHUNK, broadcast(E3) * z * (zz + zz - three * (xx + yy)));
    store(b + 13 * CHUNK, broadcast(E2) * x * four), store(b + 14 * CHUNK, broadcast(E5) * z * (xx - yy));
    store(b + 15 * CHUNK, broadcast(E0) * x * (xx - three * yy));
  }
}

// Gradient of sum_j t_j basis_j with respect to the unit direction, for the lanes at `i`; t [MOST].
void differentiate_direction(int degree, const Chunk& c, int i, const Vec* t, Vec* g) {
  const Vec x = load(c.x + i), y = load(c.y + i), z = load(c.z + i), c1 = broadcast(C1);
  g[0] = broadcast(0.f) - c1 * t[3], g[1] = broadcast(0.f) - c1 * t[1], g[2] = c1 * t[2];
  if (degree < 2) return;
  const Vec a = broadcast(D0) * t[4], b = broadcast(-D0) * t[5], d = broadcast(2.f * D2) * t[6], e = broadcast(-D0) * t[7],
            f = broadcast(2.f * D4) * t[8];
  g[0] = g[0] + y * a - x * d + z * e + x * f;
  g[1] = g[1] + x * a + z * b - y * d - y * f;
  g[2] = g[2] + y * b + broadcast(2.f) * z * d + x * e;
  if (degree < 3) return;
  const Vec xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z, minus = xx - yy;
  const Vec p = broadcast(E0) * t[9], q = broadcast(E1) * t[10], r = broadcast(E2) * t[11], s = broadcast(3.f * E3) * t[12],
            u = broadcast(E2) * t[13], v = broadcast(E5) * t[14], w = broadcast(E0) * t[15], two = broadcast(2.f), three = broadcast(3.f),
            four = broadcast(4.f), six = broadcast(6.f), eight = broadcast(8.f);
  g[0] = g[0] + six * xy * p + yz * q - two * xy * r - two * xz * s + (four * zz - three * xx - yy) * u + two * xz * v + three * minus * w;
  g[1] = g[1] + three * minus * p + xz * q + (four * zz - xx - three * yy) * r - two * yz * s - two * xy * u - two * yz * v - six * xy * w;
  g[2] = g[2] + xy * q + eight * yz * r + (two * zz - xx - yy) * s + eight * xz * u + minus * v;
}

void forward(const Harmonics& h, int64_t begin, int64_t end, float* out) {
  Chunk c;
  gather(h, begin, end, c);
  const int n = static_cast<int>(end - begin), used = h.used();
  evaluate_basis(h.degree, n, c);
  alignas(64) float colour[3][CHUNK];
  for (int i = 0; i < n; i += LANES)
    for (int k = 0; k < 3; ++k) {
      Vec sum = broadcast(0.f);
      for (int j = 0; j < used; ++j) sum = fma(load(c.basis + j * CHUNK + i), load(c.coefficients + (3 * j + k) * CHUNK + i), sum);
      sum = sum + broadcast(0.5f);
      store(colour[k] + i, select_greater(broadcast(0.f), sum, broadcast(0.f), sum));  // keeps NaN
    }
  for (int i = 0; i < n; ++i)
    for (int k = 0; k < 3; ++k) out[3 * (begin + i) + k] = colour[k][i];
}

void backward(const Harmonics& h, int64_t begin, int64_t end, const float* colours, const float* upstream, float* d_means, float* d_dc,
              float* d_rest) {
  Chunk c;
  gather(h, begin, end, c);
  const int n = static_cast<int>(end - begin), used = h.used();
  evaluate_basis(h.degree, n, c);
  alignas(64) float g[3][CHUNK] = {}, d[3][CHUNK] = {};
  for (int i = 0; i < n; ++i)
    for (int k = 0; k < 3; ++k) g[k][i] = colours[3 * (begin + i) + k] > 0.f ? upstream[3 * (begin + i) + k] : 0.f;
  if (h.degree > 0)
    for (int i = 0; i < n; i += LANES) {
      const Vec red = load(g[0] + i), green = load(g[1] + i), blue = load(g[2] + i);
      Vec t[MOST], by[3];
      for (int j = 1; j < used; ++j) {
        const float* s = c.coefficients + 3 * j * CHUNK + i;
        t[j] = fma(red, load(s), fma(green, load(s + CHUNK), blue * load(s + 2 * CHUNK)));
      }
      differentiate_direction(h.degree, c, i, t, by);
      const Vec x = load(c.x + i), y = load(c.y + i), z = load(c.z + i), inverse = load(c.inverse + i);
      const Vec along = fma(x, by[0], fma(y, by[1], z * by[2]));  // the component along the direction changes only its length
      store(d[0] + i, (by[0] - x * along) * inverse);
      store(d[1] + i, (by[1] - y * along) * inverse);
      store(d[2] + i, (by[2] - z * along) * inverse);
    }
  for (int i = 0; i < n; ++i) {
    const int64_t row = h.row(begin + i);
    float *rest = d_rest + 3 * h.width * row, *dc = d_dc + 3 * row;
    for (int k = 0; k < 3; ++k) d_means[3 * (begin + i) + k] = d[k][i], dc[k] = C0 * g[k][i];
    const float red = g[0][i], green = g[1][i], blue = g[2][i];
    for (int j = 1; j < used; ++j) {
      const float b = c.basis[j * CHUNK + i];
      rest[3 * j - 3] = b * red, rest[3 * j - 2] = b * green, rest[3 * j - 1] = b * blue;
    }
  }
}

}  // namespace
}  // namespace se

SE_EXPORT void se_sh_forward(const float* means, const float* dc, const float* rest, const int64_t* rows, int64_t count, int64_t width,
                             int32_t degree, const float* position, float* out, int32_t threads) {
  const se::Harmonics h{means, dc, rest, rows, width, degree, position};
  se::parallel_for(count, se::CHUNK, threads, [&](int64_t begin, int64_t end, int) { se::forward(h, begin, end, out); });
}

SE_EXPORT void se_sh_backward(const float* means, const float* dc, const float* rest, const int64_t* rows, const float* position,
                              const float* colours, const float* upstream, float* d_means, float* d_dc, float* d_rest, int64_t count,
                              int64_t width, int32_t degree, int32_t threads) {
  const se::Harmonics h{means, dc, rest, rows, width, degree, position};
  se::parallel_for(count, se::CHUNK, threads,
                   [&](int64_t begin, int64_t end, int) { se::backward(h, begin, end, colours, upstream, d_means, d_dc, d_rest); });
}
