// Both passes of the rasterizer: any size, any shape of Gaussian, the same bits for any number of threads.
#include <stdexcept>
#include <string>
#include <thread>

#include "checks.h"
#include "pool.h"
#include "rasterize.h"

namespace checks {
namespace {

struct Scene {
  int64_t count;
  int sh_count, width, height;
  Floats means, quats, scales, opacities, sh;
  mien::View view;

  mien::GaussianArrays arrays() const {
    return {count, sh_count, means.data(), quats.data(), scales.data(), opacities.data(), sh.data()};
  }
};

struct Result {
  Floats image, alpha, means, quats, scales, opacities, sh, means2d, view;
  std::vector<int32_t> radii;
  bool operator==(const Result&) const = default;
};

Scene random_scene(uint32_t seed, int64_t count, int sh_count, int width, int height) {
  Random random(seed);
  Scene s{count, sh_count, width, height, {}, {}, {}, {}, {}, {}};
  s.means = random.normal(3 * count, 0.4f);
  s.quats = random.normal(4 * count);
  s.scales = random.normal(3 * count);
  for (float& scale : s.scales) scale = 0.02f * std::exp(scale);
  s.opacities = random.uniform(count);
  s.sh = random.normal(3 * count * sh_count, 0.4f);
  const float focal = 1.1f * static_cast<float>(std::max(width, 8));
  s.view = {{1, 0, 0, 0, 1, 0, 0, 0, 1},
            {0.05f, -0.02f, 0.9f},
            focal,
            1.1f * focal,
            0.48f * width,
            0.55f * height,
            width,
            height,
            {0.2f, 0.5f, 1}};
  return s;
}

// What no sensible scene has, all in one.
void spoil(Scene& s) {
  for (int64_t i = 0; i < s.count; ++i) {
    float *mean = &s.means[3 * i], *quat = &s.quats[4 * i], *scale = &s.scales[3 * i];
    switch (i % 12) {
      case 0:
        quat[0] = quat[1] = quat[2] = quat[3] = 0;
        break;
      case 1:
        scale[0] = scale[1] = scale[2] = 0;
        break;
      case 2:
        scale[0] = 1e3f, scale[1] = scale[2] = 1e-6f;
        break;
      case 3:
        scale[0] = scale[1] = scale[2] = 1e4f;
        break;
      case 4:
        s.opacities[i] = 0;
        break;
      case 5:
        s.opacities[i] = 1;
        break;
      case 6:
        mean[2] = -0.9f;
        break;  // on the camera
      case 7:
        mean[2] = -5;
        break;  // behind it
      case 8:
        mean[0] = 1e6f;
        break;  // far outside
      case 9:
        mean[2] = 1e6f;
        break;  // far away
      case 10:
        mean[2] = -0.9f + 0.0101f;
        break;  // touching the near plane
      default:
        quat[0] = 1e-20f;
        break;
    }
  }
}

Result draw(const Scene& s, uint32_t seed) {
  const int64_t pixels = static_cast<int64_t>(s.width) * s.height, n = s.count;
  Result r{Floats(3 * pixels),
           Floats(pixels),
           Floats(3 * n),
           Floats(4 * n),
           Floats(3 * n),
           Floats(n),
           Floats(3 * n * s.sh_count),
           Floats(2 * n),
           Floats(mien::kViewGradients),
           std::vector<int32_t>(n)};
  const auto frame =
      mien::rasterize_forward(s.arrays(), s.view, {r.image.data(), r.alpha.data(), r.radii.data()}, true);
  CHECK(frame != nullptr);
  Floats image(3 * pixels), alpha(pixels);
  CHECK(mien::rasterize_forward(s.arrays(), s.view, {image.data(), alpha.data(), r.radii.data()}, false));
  CHECK(image == r.image && alpha == r.alpha);
  Random random(seed);
  const Floats grad_image = random.normal(3 * pixels), grad_alpha = random.normal(pixels);
  mien::rasterize_backward(
      *frame, s.arrays(), s.view,
      {r.image.data(), r.alpha.data(), grad_image.data(), seed % 2 ? grad_alpha.data() : nullptr},
      {r.means.data(), r.quats.data(), r.scales.data(), r.opacities.data(), r.sh.data(), r.means2d.data()},
      r.view.data());
  return r;
}

void check_scene(const Scene& s, uint32_t seed) {
  mien::set_thread_count(1);
  const Result serial = draw(s, seed);
  for (const Floats* values : {&serial.image, &serial.alpha, &serial.means, &serial.quats, &serial.scales,
                               &serial.opacities, &serial.sh, &serial.means2d, &serial.view})
    CHECK(all_finite(*values));
  for (float alpha : serial.alpha) CHECK(alpha >= 0 && alpha <= 1);
  mien::set_thread_count(3);
  CHECK(draw(s, seed) == serial);
}

void check_what_is_not_finite() {
  for (float value : {NAN, INFINITY, -INFINITY}) {
    Scene s = random_scene(0, 40, 4, 30, 20);
    s.means[0] = s.means[1] = 0, s.means[2] = 0.2f, s.opacities[0] = 0.5f;
    Floats* const inputs[] = {&s.means, &s.quats, &s.scales, &s.opacities, &s.sh};
    for (Floats* input : inputs) {
      const float before = (*input)[0];
      (*input)[0] = value;
      Floats image(3 * 600), alpha(600);
      std::vector<int32_t> radii(40);
      CHECK(!mien::rasterize_forward(s.arrays(), s.view, {image.data(), alpha.data(), radii.data()}, true));
      (*input)[0] = before;
    }
  }
}

// As many Gaussians as wide as the widest picture are refused, before they take memory.
void check_too_many_pairs() {
  Scene s = random_scene(3, mien::kMostPairs / (mien::kMostPictureSide / 32) + 1, 1, mien::kMostPictureSide, 1);
  s.scales.assign(s.scales.size(), 3.0f);
  s.opacities.assign(s.opacities.size(), 0.5f);
  for (int64_t i = 0; i < s.count; ++i) {
    s.means[3 * i] = s.means[3 * i + 1] = 0;
    s.means[3 * i + 2] = 1.0f / static_cast<float>(i + 1);
  }
  const Scene small = random_scene(4, 200, 1, 61, 45);
  const Result expected = draw(small, 4);
  Floats image(3 * s.width), alpha(s.width);
  std::vector<int32_t> radii(s.count);
  bool refused = false;
  try {
    mien::rasterize_forward(s.arrays(), s.view, {image.data(), alpha.data(), radii.data()}, true);
  } catch (const std::length_error& error) {
    const std::string pairs = std::to_string(s.count * (mien::kMostPictureSide / 32));
    refused = std::string(error.what()).find(pairs) != std::string::npos;
  }
  CHECK(refused);
  CHECK(draw(small, 4) == expected);
}

// Several views at once, each on a thread of its caller, as evaluation draws frames.
void check_views_side_by_side() {
  std::vector<Scene> scenes;
  std::vector<Result> expected;
  mien::set_thread_count(1);
  for (uint32_t seed = 0; seed < 4; ++seed) {
    scenes.push_back(random_scene(seed, 400, 1, 70, 50));
    expected.push_back(draw(scenes[seed], seed));
  }
  mien::set_thread_count(3);
  std::vector<std::thread> threads;
  for (uint32_t seed = 0; seed < 4; ++seed) {
    threads.emplace_back([&, seed] {
      for (int repeat = 0; repeat < 3; ++repeat) CHECK(draw(scenes[seed], seed) == expected[seed]);
    });
  }
  for (auto& thread : threads) thread.join();
  mien::parallel_for(4,
                     [&](int64_t seed) { CHECK(draw(scenes[seed], static_cast<uint32_t>(seed)) == expected[seed]); });
}

}  // namespace

void check_rasterizer() {
  uint32_t seed = 0;
  for (int64_t count : {0, 1, 2, 15, 16, 17, 255, 257, 3000}) {
    ++seed;
    check_scene(random_scene(seed, count, 1, 61, 45), seed);
  }
  for (int sh_count : {1, 4, 9, 16}) {
    ++seed;
    check_scene(random_scene(seed, 300, sh_count, 40, 33), seed);
  }
  const int sizes[][2] = {{1, 1}, {3, 70}, {32, 32}, {33, 31}, {129, 65}, {2000, 3}, {3, 2000}};
  for (const auto& [width, height] : sizes) {
    Scene scene = random_scene(seed += 1, 150, 4, width, height);
    check_scene(scene, seed);
    spoil(scene);
    check_scene(scene, seed);
  }
  check_what_is_not_finite();
  check_too_many_pairs();
  check_views_side_by_side();
}

}  // namespace checks
