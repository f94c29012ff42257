// The network of blended features and the update of its bases: odd widths, the same bits for any number of threads.
#include <algorithm>

#include "checks.h"
#include "feature_network.h"
#include "pool.h"
#include "training.h"

namespace checks {
namespace {

struct Sizes {
  int64_t count, inputs;
  int features, own, hidden, width;
};

struct NetworkResult {
  Floats outputs, last, by_features, by_weight1, by_bias1, by_weight2, by_bias2, by_inputs, by_owns;
  bool operator==(const NetworkResult&) const = default;
};

std::vector<mien::FeatureInput> inputs_of(const Sizes& s, const Floats& bases, const Floats& values, bool by_input) {
  const int64_t between = by_input ? s.count * s.features : s.features;
  const int64_t stride = by_input ? s.features : s.inputs * s.features;
  std::vector<mien::FeatureInput> items;
  for (int64_t k = 0; k < s.inputs; ++k) items.push_back({bases.data() + k * between, stride, values[k]});
  return items;
}

NetworkResult run(const Sizes& s, bool by_input) {
  Random random(3);
  const int64_t in = s.features + s.own;
  const Floats bases = random.normal(s.count * s.inputs * s.features), neutral = random.normal(s.count * s.features);
  Floats values = random.normal(s.inputs);
  if (s.inputs > 2) values[1] = 0;
  const Floats own = random.normal(s.count * s.own), weight1 = random.normal(s.hidden * in);
  const Floats bias1 = random.normal(s.hidden), weight2 = random.normal(s.width * s.hidden);
  const Floats bias2 = random.normal(s.width);
  const mien::FeatureNetwork network{s.count,      s.features,     s.own,       s.hidden,
                                     s.width,      neutral.data(), own.data(),  weight1.data(),
                                     bias1.data(), weight2.data(), bias2.data()};
  const auto items = inputs_of(s, bases, values, by_input);
  const mien::FeatureInputs inputs{items.data(), s.inputs};
  Floats features(s.count * s.features), hidden(s.count * mien::hidden_stride(s.hidden));
  NetworkResult r;
  r.outputs.resize(s.count * (s.width - 1));
  r.last.resize(s.count);
  mien::feature_network(network, inputs, {features.data(), hidden.data()}, r.outputs.data(), r.last.data());
  Floats alone(r.outputs.size()), last(s.count);
  mien::feature_network(network, inputs, {}, alone.data(), last.data());
  CHECK(alone == r.outputs && last == r.last);
  Floats by_outputs = random.normal(r.outputs.size()), by_last = random.normal(s.count);
  for (int64_t i = 0; i < s.count; i += 3) {  // without gradients
    by_last[i] = 0;
    std::fill_n(by_outputs.begin() + i * (s.width - 1), s.width - 1, 0.0f);
  }
  r.by_features.resize(neutral.size()), r.by_weight1.resize(weight1.size()), r.by_bias1.resize(s.hidden);
  r.by_weight2.resize(weight2.size()), r.by_bias2.resize(s.width), r.by_inputs.resize(s.inputs);
  r.by_owns.resize(own.size());
  mien::feature_network_backward(
      network, inputs, {features.data(), hidden.data()},
      {by_outputs.data(), by_last.data(), r.by_features.data(), r.by_weight1.data(), r.by_bias1.data(),
       r.by_weight2.data(), r.by_bias2.data(), r.by_inputs.data(), r.by_owns.data()});
  return r;
}

void check_network() {
  for (const Sizes& sizes : {Sizes{0, 3, 4, 2, 5, 3}, Sizes{1, 1, 1, 0, 1, 1}, Sizes{47, 4, 15, 3, 17, 16},
                             Sizes{49, 2, 16, 27, 64, 49}, Sizes{1700, 5, 33, 1, 9, 18}}) {
    for (bool by_input : {false, true}) {
      mien::set_thread_count(1);
      const NetworkResult serial = run(sizes, by_input);
      CHECK(all_finite(serial.outputs) && all_finite(serial.by_features) && all_finite(serial.by_weight1));
      CHECK(all_finite(serial.by_weight2) && all_finite(serial.by_inputs) && all_finite(serial.by_bias1));
      CHECK(all_finite(serial.by_owns));
      mien::set_thread_count(3);
      CHECK(run(sizes, by_input) == serial);
    }
  }
}

// Adam on factors has the bits of Adam on their product, for any number of threads.
void check_adam() {
  for (int width : {1, 15, 16, 33}) {
    for (int threads : {1, 3}) {
      mien::set_thread_count(threads);
      Random random(6);
      const int64_t count = 300, columns_count = 5, size = count * columns_count * width;
      Floats values = random.normal(size), first = random.normal(size), second = random.uniform(size);
      Floats plain = values, plain_first = first, plain_second = second, gradient(size);
      const Floats rows = random.normal(count * width), columns = random.normal(columns_count);
      for (int64_t i = 0; i < size; ++i)
        gradient[i] = rows[i / (columns_count * width) * width + i % width] * columns[i / width % columns_count];
      const mien::FactoredTerm term{rows.data(), columns.data()};
      mien::factored_adam_update({values.data(), &term, first.data(), second.data(), count,
                                  static_cast<int>(columns_count), width, 1, 0.01f, 2.0f});
      const mien::AdamTask task{plain.data(), gradient.data(), plain_first.data(), plain_second.data(), size, 0.01f,
                                2.0f};
      mien::adam_update(&task, 1);
      CHECK(values == plain && first == plain_first && second == plain_second);
    }
  }
}

void check_update() {
  for (int width : {1, 15, 16, 33}) {
    Floats results[2];
    for (int threads : {1, 3}) {
      mien::set_thread_count(threads);
      Random random(5);
      const int64_t count = 1700, columns_count = 3;
      Floats values = random.normal(count * columns_count * width), second = random.uniform(count * width);
      Floats weights = random.uniform(count), rows = random.normal(count * width),
             columns = random.normal(columns_count), other = random.normal(count * width);
      std::fill_n(rows.begin(), 5 * width, 0.0f);
      columns[1] = 0;
      // The third term takes the first away, but for rounding.
      Floats against = rows;
      for (float& value : against) value = -value;
      const mien::FactoredTerm terms[] = {
          {rows.data(), columns.data()}, {other.data(), columns.data()}, {against.data(), columns.data()}};
      for (const int used : {1, 3}) {
        mien::factored_update(
            {values.data(), count, columns_count, width, terms, used, second.data(), weights.data(), 0.01f});
      }
      CHECK(all_finite(values) && all_finite(second));
      results[threads > 1] = values;
    }
    CHECK(results[0] == results[1]);
  }
}

}  // namespace

void check_feature_network() {
  check_network();
  check_update();
  check_adam();
}

}  // namespace checks
