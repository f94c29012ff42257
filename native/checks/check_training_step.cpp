// The rig, the photometric loss, Adam, penalties and statistics: odd lengths, the same bits for any number of threads.
#include "activation.h"
#include "checks.h"
#include "memory.h"
#include "photometric.h"
#include "pool.h"
#include "rig.h"
#include "training.h"

namespace checks {
namespace {

struct RigResult {
  Floats means, quats, scales, local_means, local_quats, log_scales, vertices;
  bool operator==(const RigResult&) const = default;
};

RigResult ride(int64_t count, int64_t faces, uint32_t seed) {
  Random random(seed);
  const int64_t vertex_count = 20;
  Floats vertices = random.normal(3 * vertex_count);
  std::vector<int64_t> corners(3 * faces), face_index(count);
  for (auto& corner : corners) corner = random.below(vertex_count);  // some triangles are degenerate
  for (auto& face : face_index) face = random.below(faces);
  const Floats means = random.normal(3 * count), quats = random.normal(4 * count), scales = random.normal(3 * count);
  const mien::RigArrays rig{vertices.data(), vertex_count, corners.data(), faces,        face_index.data(),
                            count,           means.data(), quats.data(),   scales.data()};
  std::vector<mien::TriangleFrame> frames(faces);
  RigResult r{Floats(3 * count), Floats(4 * count), Floats(3 * count),       Floats(3 * count),
              Floats(4 * count), Floats(3 * count), Floats(3 * vertex_count)};
  mien::rig_forward(rig, frames.data(), {r.means.data(), r.quats.data(), r.scales.data()});
  const Floats by_means = random.normal(3 * count), by_quats = random.normal(4 * count);
  const Floats by_scales = random.normal(3 * count);
  const mien::RigTopology topology(vertex_count, corners.data(), faces, face_index.data(), count);
  mien::rig_backward(topology, rig, frames.data(), r.scales.data(),
                     {by_means.data(), by_quats.data(), by_scales.data(), false, r.local_means.data(),
                      r.local_quats.data(), r.log_scales.data(), r.vertices.data()});
  return r;
}

void check_rig() {
  for (int64_t count : {0, 1, 3, 15, 16, 17, 5000}) {
    for (int64_t faces : {1, 7, 2500}) {
      mien::set_thread_count(1);
      const RigResult serial = ride(count, faces, 1);
      CHECK(all_finite(serial.means) && all_finite(serial.vertices) && all_finite(serial.local_quats));
      mien::set_thread_count(3);
      CHECK(ride(count, faces, 1) == serial);
    }
  }
}

struct LossResult {
  double value;
  Floats gradient;
  bool operator==(const LossResult&) const = default;
};

LossResult lose(int width, int height, mien::Box box, bool bytes) {
  Random random(3);
  const int64_t floats = 3ll * width * height;
  const Floats image = random.uniform(floats), target = random.uniform(floats);
  std::vector<uint8_t> target_bytes(floats);
  for (auto& byte : target_bytes) byte = static_cast<uint8_t>(random.below(256));
  LossResult r{0, Floats(floats)};
  r.value =
      mien::photometric_loss({image.data(), bytes ? nullptr : target.data(), bytes ? target_bytes.data() : nullptr,
                              width, height, box, 0.8f, 0.2f, r.gradient.data()});
  return r;
}

void check_photometric_loss() {
  const struct {
    int width, height;
    mien::Box box;
  } cases[] = {{6, 1, {0, 0, 6, 1}},          {6, 40, {0, 0, 6, 40}},     {37, 53, {5, 7, 25, 18}},
               {64, 48, {0, 0, 64, 48}},      {64, 48, {63, 47, 64, 48}}, {300, 3, {2, 0, 299, 3}},
               {200, 101, {90, 80, 200, 101}}};
  for (const auto& one : cases) {
    for (bool bytes : {false, true}) {
      mien::set_thread_count(1);
      const LossResult serial = lose(one.width, one.height, one.box, bytes);
      CHECK(std::isfinite(serial.value) && all_finite(serial.gradient));
      mien::set_thread_count(3);
      CHECK(lose(one.width, one.height, one.box, bytes) == serial);
    }
  }
}

void check_adam() {
  std::vector<Floats> first, second;
  for (int threads : {1, 3}) {
    mien::set_thread_count(threads);
    Random random(5);
    std::vector<Floats> arrays;
    std::vector<mien::AdamTask> tasks;
    for (int64_t count : {0, 1, 15, 16, 17, 40000}) {
      for (int j = 0; j < 4; ++j) arrays.push_back(j == 3 ? random.uniform(count) : random.normal(count));
      Floats* own = &arrays[arrays.size() - 4];
      tasks.push_back({own[0].data(), own[1].data(), own[2].data(), own[3].data(), count, 1e-3f, 1.5f, {}});
    }
    mien::adam_update(tasks.data(), static_cast<int>(tasks.size()));
    for (const Floats& array : arrays) CHECK(all_finite(array));
    (threads == 1 ? first : second) = std::move(arrays);
  }
  CHECK(first == second);
}

void check_penalties_and_statistics() {
  for (int64_t count : {0, 1, 15, 16, 17, 9001}) {
    Random random(7);
    const Floats means = random.normal(3 * count), log_scales = random.normal(3 * count);
    const Floats gradient = random.normal(2 * count), opacities = random.uniform(count);
    std::vector<int32_t> radii(count), radius(count);
    for (auto& value : radii) value = static_cast<int32_t>(random.below(3));
    double sums[2];
    for (int threads : {1, 3}) {
      mien::set_thread_count(threads);
      Floats by_means(3 * count), by_scales(3 * count);
      const mien::Penalties sum = mien::triangle_penalties(
          {count, means.data(), log_scales.data(), radii.data(), 1, 0.5f, 0.6f, 2, by_means.data(), by_scales.data()});
      CHECK(all_finite(by_means) && all_finite(by_scales));
      sums[threads > 1] = sum.position + sum.scale;
    }
    CHECK(sums[0] == sums[1]);
    Floats pull(count), seen(count), opacity(count);
    mien::observe_view({count, gradient.data(), radii.data(), opacities.data(), 256, 128, pull.data(), seen.data(),
                        radius.data(), opacity.data()});
    CHECK(all_finite(pull) && all_finite(seen) && radius == radii && opacity == opacities);
  }
}

void check_box() {
  for (int width : {1, 15, 16, 17, 100}) {
    for (int height : {1, 5}) {
      Floats values(static_cast<size_t>(width) * height);
      mien::PixelBox box = mien::box_of_nonzero(values.data(), width, height);
      CHECK(box.left == 0 && box.top == 0 && box.right == 0 && box.bottom == 0);
      values.back() = 1;
      box = mien::box_of_nonzero(values.data(), width, height);
      CHECK(box.left == width - 1 && box.top == height - 1 && box.right == width && box.bottom == height);
    }
  }
}

void check_sigmoid() {
  for (int64_t count : {0, 1, 15, 16, 17, 40000}) {
    Floats results[2], gradients[2];
    for (int threads : {1, 3}) {
      mien::set_thread_count(threads);
      Random random(9);
      Floats values = random.normal(count, 60), out(count), back(count);
      const Floats gradient = random.normal(count);
      mien::sigmoid(values.data(), count, out.data());
      mien::sigmoid_backward(out.data(), gradient.data(), count, back.data());
      for (float value : out) CHECK(value >= 0 && value <= 1);
      CHECK(all_finite(back));
      results[threads > 1] = out;
      gradients[threads > 1] = back;
    }
    CHECK(results[0] == results[1] && gradients[0] == gradients[1]);
  }
}

// Memory comes back, to one owner at a time, and no more of it is kept than is allowed.
void check_memory() {
  const size_t bytes = size_t{100} << 20;
  void* const first = mien::take_memory(bytes);
  void* const second = mien::take_memory(bytes);
  CHECK(first && second && first != second && reinterpret_cast<uintptr_t>(first) % 64 == 0);
  mien::give_memory(first, bytes);
  CHECK(mien::take_memory(bytes) == first);
  mien::give_memory(first, bytes);
  mien::give_memory(second, bytes);
  mien::give_memory(mien::take_memory(bytes + 1), bytes + 1);  // 300 MB: the oldest goes
  CHECK(mien::take_memory(bytes) == second);
  mien::give_memory(second, bytes);
  mien::parallel_for(100, [](int64_t index) {
    const size_t own = 64 + static_cast<size_t>(index % 3);
    auto* const memory = static_cast<unsigned char*>(mien::take_memory(own));
    for (size_t i = 0; i < own; ++i) memory[i] = static_cast<unsigned char>(index);
    for (size_t i = 0; i < own; ++i) CHECK(memory[i] == static_cast<unsigned char>(index));
    mien::give_memory(memory, own);
  });
}

}  // namespace

void check_training_step() {
  check_rig();
  check_photometric_loss();
  check_adam();
  check_penalties_and_statistics();
  check_box();
  check_sigmoid();
  check_memory();
}

}  // namespace checks
