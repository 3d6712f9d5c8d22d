// Features of graph points blended with their neighbours' (scene/graph/network.py) and a multi-resolution hash
// grid (scene/graph/hash_grid.py), forward and backward. One worker owns each output row, or each level of the
// grid, and adds in a fixed order, so the number of threads does not change a bit.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "pool.h"
#include "se_api.h"

namespace {
constexpr int64_t kRows = 256, kPlaces = 512;  // per chunk
constexpr uint32_t kPrimeY = 2654435761u, kPrimeZ = 805459861u;

struct Edges {
  const int64_t* found;  // [A, k], -1: no neighbour
  const float* weight;   // [A, k]
  const int32_t* start;  // [A + 1]: begin of the list of edges that lead to a point
  const int32_t* known;  // edges u k + j that lead to it, ascending
  int64_t k;
};

struct Level {
  int64_t first, rows, cells;
  bool dense;
};

// Table rows and weights of the eight corners around a point; z changes fastest.
inline void find_corners(const float* unit, const Level& level, int32_t row[8], float weight[8]) {
  int64_t at[3];
  float share[3][2];
  for (int a = 0; a < 3; ++a) {
    const float place = unit[a] * static_cast<float>(level.cells), low = std::floor(place);
    at[a] = static_cast<int64_t>(low);
    share[a][1] = place - low;
    share[a][0] = 1.f - share[a][1];
  }
  if (level.dense) {
    const int64_t side = level.cells + 1;
    for (int i = 0; i < 8; ++i) {
      int64_t r = at[0] + (i >> 2) + side * (at[1] + ((i >> 1) & 1) + side * (at[2] + (i & 1)));
      if (r < 0 || r >= level.rows) r = (r % level.rows + level.rows) % level.rows;
      row[i] = static_cast<int32_t>(r);
    }
  } else {
    const uint32_t x = static_cast<uint32_t>(at[0]), y = static_cast<uint32_t>(at[1]) * kPrimeY, z = static_cast<uint32_t>(at[2]) * kPrimeZ;
    const uint32_t xs[2] = {x, x + 1}, ys[2] = {y, y + kPrimeY}, zs[2] = {z, z + kPrimeZ}, mask = static_cast<uint32_t>(level.rows - 1);
    for (int i = 0; i < 8; ++i) row[i] = static_cast<int32_t>((xs[i >> 2] ^ ys[(i >> 1) & 1] ^ zs[i & 1]) & mask);
  }
  for (int i = 0; i < 8; ++i) weight[i] = share[0][i >> 2] * share[1][(i >> 1) & 1] * share[2][i & 1];
}

// One level for points [begin, end) with C features per row, or `features` if C is 0.
template <int C>
void blend_level(const Level& level, const float* table, const float* unit, int64_t begin, int64_t end, int64_t stride, int64_t features,
                 float* out) {
  const int64_t n = C ? C : features;
  for (int64_t a = begin; a < end; ++a) {
    int32_t row[8];
    float weight[8];
    find_corners(unit + 3 * a, level, row, weight);
    float* to = out + a * stride;
    for (int64_t c = 0; c < n; ++c) {
      float sum = 0.f;
      for (int i = 0; i < 8; ++i) sum += weight[i] * table[row[i] * n + c];
      to[c] = sum;
    }
  }
}

template <int C>
void scatter_level(const Level& level, const float* unit, const float* grad, int64_t A, int64_t stride, int64_t features, float* out) {
  const int64_t n = C ? C : features;
  for (int64_t a = 0; a < A; ++a) {
    int32_t row[8];
    float weight[8];
    find_corners(unit + 3 * a, level, row, weight);
    const float* from = grad + a * stride;
    for (int i = 0; i < 8; ++i)
      for (int64_t c = 0; c < n; ++c) out[row[i] * n + c] += weight[i] * from[c];
  }
}

inline Level describe_level(const int64_t* cells, const int64_t* rows, int64_t l) {
  int64_t first = 0;
  for (int64_t i = 0; i < l; ++i) first += rows[i];
  const double side = static_cast<double>(cells[l] + 1);  // its cube may exceed 64 bits
  return {first, rows[l], cells[l], side * side * side <= static_cast<double>(rows[l])};
}
}  // namespace

SE_EXPORT void se_graph_reverse(const int64_t* found, int64_t A, int64_t k, int32_t* start, int32_t* known) {
  std::fill(start, start + A + 1, 0);
  for (int64_t e = 0; e < A * k; ++e)
    if (found[e] >= 0) ++start[found[e] + 1];
  for (int64_t v = 0; v < A; ++v) start[v + 1] += start[v];
  for (int64_t e = 0; e < A * k; ++e)
    if (found[e] >= 0) known[start[found[e]]++] = static_cast<int32_t>(e);
  for (int64_t v = A; v > 0; --v) start[v] = start[v - 1];  // each start is now the begin of the next point's list: shift by one
  start[0] = 0;
}

SE_EXPORT void se_graph_forward(const float* feature, const int64_t* found, const float* weight, const int32_t* start, const int32_t* known,
                                int64_t A, int64_t k, int64_t F, float share, float* least, float* out, int32_t threads) {
  const Edges e{found, weight, start, known, k};
  se::parallel_for(A, kRows, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t v = begin; v < end; ++v) {
      float* to = least + v * F;
      for (int64_t c = 0; c < F; ++c) to[c] = feature[v * F + c];  // every point counts as its own neighbour
      for (int32_t i = e.start[v]; i < e.start[v + 1]; ++i) {
        const float* f = feature + e.known[i] / e.k * F;
        for (int64_t c = 0; c < F; ++c) to[c] = std::min(to[c], f[c]);
      }
    }
  });
  se::parallel_for(A, kRows, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t u = begin; u < end; ++u) {
      float* to = out + u * F;
      for (int64_t c = 0; c < F; ++c) to[c] = feature[u * F + c];
      for (int64_t j = 0; j < e.k; ++j) {
        const int64_t v = e.found[u * e.k + j];
        const float w = share * e.weight[u * e.k + j];
        if (v < 0 || w == 0.f) continue;
        for (int64_t c = 0; c < F; ++c) to[c] += w * (feature[v * F + c] - least[v * F + c]);
      }
    }
  });
}

SE_EXPORT void se_graph_backward(const float* feature, const float* least, const float* grad, const int64_t* found, const float* weight,
                                 const int32_t* start, const int32_t* known, int64_t A, int64_t k, int64_t F, float share, float* h,
                                 float* shared, float* out, int32_t threads) {
  const Edges e{found, weight, start, known, k};
  se::parallel_for(A, kRows, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t v = begin; v < end; ++v) {
      float *to = h + v * F, *holders = shared + v * F;
      const float* low = least + v * F;
      for (int64_t c = 0; c < F; ++c) to[c] = holders[c] = 0.f;
      for (int32_t i = e.start[v]; i < e.start[v + 1]; ++i) {
        const int64_t u = e.known[i] / e.k;
        const float w = share * e.weight[e.known[i]];
        const float *f = feature + u * F, *g = grad + u * F;
        for (int64_t c = 0; c < F; ++c) {
          to[c] += w * g[c];
          holders[c] += f[c] == low[c] ? 1.f : 0.f;
        }
      }
      for (int64_t c = 0; c < F; ++c) holders[c] = to[c] / std::max(holders[c], 1.f);
    }
  });
  se::parallel_for(A, kRows, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t u = begin; u < end; ++u) {
      float* to = out + u * F;
      const float* f = feature + u * F;
      for (int64_t c = 0; c < F; ++c) to[c] = grad[u * F + c] + h[u * F + c];
      for (int64_t j = 0; j < e.k; ++j) {
        const int64_t v = e.found[u * e.k + j];
        if (v < 0) continue;
        const float *low = least + v * F, *g = shared + v * F;
        for (int64_t c = 0; c < F; ++c) to[c] -= f[c] == low[c] ? g[c] : 0.f;
      }
    }
  });
}

SE_EXPORT void se_grid_forward(const float* table, const float* unit, const int64_t* cells, const int64_t* rows, int64_t A, int64_t levels,
                               int64_t features, float* out, int32_t threads) {
  se::parallel_for(A, kPlaces, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t l = 0; l < levels; ++l) {  // level by level, so that its part of the table stays in the cache
      const Level level = describe_level(cells, rows, l);
      const auto run = features == 2 ? blend_level<2> : blend_level<0>;
      run(level, table + level.first * features, unit, begin, end, levels * features, features, out + l * features);
    }
  });
}

SE_EXPORT void se_grid_backward(const float* unit, const float* grad, const int64_t* cells, const int64_t* rows, int64_t A, int64_t levels,
                                int64_t features, float* out, int32_t threads) {
  se::parallel_for(levels, 1, threads, [&](int64_t begin, int64_t end, int) {
    for (int64_t l = begin; l < end; ++l) {
      const Level level = describe_level(cells, rows, l);
      const auto run = features == 2 ? scatter_level<2> : scatter_level<0>;
      run(level, unit, grad + l * features, A, levels * features, features, out + level.first * features);
    }
  });
}
