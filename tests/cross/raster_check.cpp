// Render a synthetic scene with the library that this program is linked to. Print the sum and the norm of the image and of every gradient,
// so that tests/system/test_cross.py can compare builds for different processors without Python. Print the time of the frame to stderr.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <vector>

#include "se_api.h"

namespace {

struct Random {  // the same numbers everywhere
  uint64_t state = 1;
  float operator()(float low, float high) {
    state = state * 6364136223846793005u + 1442695040888963407u;
    return low + (high - low) * static_cast<float>(state >> 40) / 16777216.0f;
  }
};

void print(const char* name, const std::vector<float>& values) {
  double sum = 0, squares = 0;
  for (const float v : values) sum += v, squares += static_cast<double>(v) * v;
  std::printf("%s %.9g %.9g\n", name, sum, std::sqrt(squares));
}

}  // namespace

int main() {
  const int m = 3000, width = 150, height = 101;
  Random random;
  std::vector<float> means(3 * m), quats(4 * m), scales(3 * m), opacities(m), colors(3 * m);
  for (int i = 0; i < m; ++i) {
    means[3 * i] = random(-2, 2), means[3 * i + 1] = random(-1.5f, 1.5f), means[3 * i + 2] = random(0.5f, 5);
    float length = 0;
    for (int k = 0; k < 4; ++k) quats[4 * i + k] = random(-1, 1), length += quats[4 * i + k] * quats[4 * i + k];
    for (int k = 0; k < 4; ++k) quats[4 * i + k] /= std::sqrt(length);
    for (int k = 0; k < 3; ++k) scales[3 * i + k] = random(0.01f, 0.08f), colors[3 * i + k] = random(0, 1);
    opacities[i] = random(0.01f, 0.98f);
  }
  const size_t pixels = static_cast<size_t>(width) * height;
  const float background[3] = {0.2f, 0.5f, 0.9f};
  std::vector<float> image(3 * pixels), alpha(pixels), depth(pixels), up(3 * pixels);
  for (float& v : up) v = random(-1, 1);
  std::vector<int32_t> radii(m);
  const SeCamera camera{{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1}, 120, 125, 80, 48, 0.01f, width, height};
  SeRasterForward forward{};
  forward.camera = camera, forward.threads = 2, forward.m = m;
  forward.means = means.data(), forward.quats = quats.data(), forward.scales = scales.data();
  forward.opacities = opacities.data(), forward.colors = colors.data(), forward.background = background;
  forward.image = image.data(), forward.alpha = alpha.data(), forward.depth = depth.data(), forward.radii = radii.data();
  std::vector<float> d_means(3 * m), d_quats(4 * m), d_scales(3 * m), d_opacities(m), d_colors(3 * m), d_mean2d(2 * m), d_background(3);
  SeRasterBackward backward{};
  backward.deterministic = 1, backward.threads = 2;
  backward.means = means.data(), backward.quats = quats.data(), backward.scales = scales.data();
  backward.opacities = opacities.data(), backward.colors = colors.data();
  backward.background = background, backward.g_image = up.data();
  backward.d_means = d_means.data(), backward.d_quats = d_quats.data(), backward.d_scales = d_scales.data();
  backward.d_opacities = d_opacities.data(), backward.d_colors = d_colors.data();
  backward.d_mean2d = d_mean2d.data(), backward.d_background = d_background.data();
  const auto start = std::chrono::steady_clock::now();
  void* state = nullptr;
  if (se_raster_forward(&forward, &state) || se_raster_backward(state, &backward)) return 1;
  const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - start;
  se_raster_release(state);
  print("image", image), print("alpha", alpha), print("depth", depth), print("means", d_means), print("quats", d_quats);
  print("scales", d_scales), print("opacities", d_opacities), print("colors", d_colors), print("mean2d", d_mean2d);
  print("background", d_background);
  std::fprintf(stderr, "%.1f ms\n", took.count());
  return 0;
}
