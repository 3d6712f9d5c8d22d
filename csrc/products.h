// The two small matrix products of the decode, on row-major blocks that stay in the L1 cache.
//   multiply:    C[m][n] = (bias[n] or 0) + sum_k A[m][k] B[k][n], stored or added by Out
//   accumulate:  C[p][n] += sum_m A[m][p] B[m][n]
// n runs along the registers and must be a multiple of 16. m (in multiply) and p (in accumulate) are rounded up
// to TILE_STEP, so A and C need room for that many rows (columns of A in accumulate), whose content does not
// matter.
#pragma once
#include "lanes.h"

namespace se {

#if defined(__AVX512F__) || defined(__aarch64__)
constexpr int TILE = 12, TILE_STEP = 4;  // TILE x 2 registers of sums, which leaves room for the operands among 32
#else
constexpr int TILE = 6, TILE_STEP = 2;
#endif
constexpr int SLACK = TILE;

// Where multiply stores C.
struct Store {
  float* c;
  int stride;
  void operator()(int row, int column, Vec sum) const { store(c + row * static_cast<int64_t>(stride) + column, sum); }
};
struct StoreRelu {
  float* c;
  int stride;
  // The order max(0, x) keeps NaN.
  void operator()(int row, int column, Vec sum) const { store(c + row * static_cast<int64_t>(stride) + column, max(broadcast(0.f), sum)); }
};
struct AddToRows {  // add row i to row index[i]; only rows that are never read may occur twice
  float* c;
  int stride;
  const int* index;
  void operator()(int row, int column, Vec sum) const {
    float* to = c + index[row] * static_cast<int64_t>(stride) + column;
    store(to, load(to) + sum);
  }
};

// Sums of `rows` rows by `wide` registers. A compile-time stride (`fixed`, 0: at run time) lets one pointer
// address all rows of A.
template <int rows, int wide, int fixed, class Out>
inline void multiply_tile(const float* a, int a_stride, const float* b, int b_stride, int k, const float* bias, const Out& out, int row,
                          int column) {
  const int64_t stride = fixed ? fixed : a_stride;
  Vec sums[rows][wide];
  for (int j = 0; j < wide; ++j) {
    const Vec start = bias ? load(bias + j * LANES) : broadcast(0.f);
#pragma GCC unroll 12
    for (int i = 0; i < rows; ++i) sums[i][j] = start;
  }
  for (int t = 0; t < k; ++t) {
    Vec right[wide];
#pragma GCC unroll 2
    for (int j = 0; j < wide; ++j) right[j] = load(b + t * static_cast<int64_t>(b_stride) + j * LANES);
#pragma GCC unroll 12
    for (int i = 0; i < rows; ++i) {
      const Vec left = broadcast(a[i * stride + t]);
#pragma GCC unroll 2
      for (int j = 0; j < wide; ++j) sums[i][j] = fma(left, right[j], sums[i][j]);
    }
  }
#pragma GCC unroll 12
  for (int i = 0; i < rows; ++i)
#pragma GCC unroll 2
    for (int j = 0; j < wide; ++j) out(row + i, column + j * LANES, sums[i][j]);
}

template <int wide, int fixed, class Out>
inline void multiply_columns(int m, int k, const float* a, int as, const float* b, int bs, const float* bias, const Out& out, int column) {
  int i = 0;
  for (; i + TILE <= m; i += TILE) multiply_tile<TILE, wide, fixed>(a + i * as, as, b, bs, k, bias, out, i, column);
  if (m - i > 2 * TILE_STEP)
    multiply_tile<TILE, wide, fixed>(a + i * as, as, b, bs, k, bias, out, i, column);
  else if (m - i > TILE_STEP)
    multiply_tile<2 * TILE_STEP, wide, fixed>(a + i * as, as, b, bs, k, bias, out, i, column);
  else if (m > i)
    multiply_tile<TILE_STEP, wide, fixed>(a + i * as, as, b, bs, k, bias, out, i, column);
}

template <int fixed, class Out>
void multiply_strided(int m, int n, int k, const float* a, int as, const float* b, int bs, const float* bias, const Out& out) {
  int j = 0;
  for (; j + 2 * LANES <= n; j += 2 * LANES) multiply_columns<2, fixed>(m, k, a, as, b + j, bs, bias ? bias + j : nullptr, out, j);
  for (; j + LANES <= n; j += LANES) multiply_columns<1, fixed>(m, k, a, as, b + j, bs, bias ? bias + j : nullptr, out, j);
}

template <class Out>
inline void multiply(int m, int n, int k, const float* a, int as, const float* b, int bs, const float* bias, const Out& out) {
  switch (as) {
    case 16:
      return multiply_strided<16>(m, n, k, a, as, b, bs, bias, out);
    case 32:
      return multiply_strided<32>(m, n, k, a, as, b, bs, bias, out);
    case 48:
      return multiply_strided<48>(m, n, k, a, as, b, bs, bias, out);
    case 80:
      return multiply_strided<80>(m, n, k, a, as, b, bs, bias, out);
    default:
      return multiply_strided<0>(m, n, k, a, as, b, bs, bias, out);
  }
}

template <int columns, int wide>
inline void accumulate_tile(int m, const float* a, int as, const float* b, int bs, float* c, int cs) {
  Vec sums[columns][wide];
#pragma GCC unroll 12
  for (int i = 0; i < columns; ++i)
#pragma GCC unroll 2
    for (int j = 0; j < wide; ++j) sums[i][j] = load(c + i * cs + j * LANES);
  for (int t = 0; t < m; ++t, a += as, b += bs) {
    Vec right[wide];
#pragma GCC unroll 2
    for (int j = 0; j < wide; ++j) right[j] = load(b + j * LANES);
#pragma GCC unroll 12
    for (int i = 0; i < columns; ++i) {
      const Vec left = broadcast(a[i]);
#pragma GCC unroll 2
      for (int j = 0; j < wide; ++j) sums[i][j] = fma(left, right[j], sums[i][j]);
    }
  }
#pragma GCC unroll 12
  for (int i = 0; i < columns; ++i)
#pragma GCC unroll 2
    for (int j = 0; j < wide; ++j) store(c + i * cs + j * LANES, sums[i][j]);
}

template <int wide>
inline void accumulate_columns(int m, int p, const float* a, int as, const float* b, int bs, float* c, int cs) {
  int i = 0;
  for (; i + TILE <= p; i += TILE) accumulate_tile<TILE, wide>(m, a + i, as, b, bs, c + i * cs, cs);
  if (p - i > 2 * TILE_STEP)
    accumulate_tile<TILE, wide>(m, a + i, as, b, bs, c + i * cs, cs);
  else if (p - i > TILE_STEP)
    accumulate_tile<2 * TILE_STEP, wide>(m, a + i, as, b, bs, c + i * cs, cs);
  else if (p > i)
    accumulate_tile<TILE_STEP, wide>(m, a + i, as, b, bs, c + i * cs, cs);
}

inline void accumulate(int m, int p, int n, const float* a, int as, const float* b, int bs, float* c, int cs) {
  int j = 0;
  for (; j + 2 * LANES <= n; j += 2 * LANES) accumulate_columns<2>(m, p, a, as, b + j, bs, c + j, cs);
  for (; j + LANES <= n; j += LANES) accumulate_columns<1>(m, p, a, as, b + j, bs, c + j, cs);
}

}  // namespace se
