// The network of blended features, the update of its bases, and changes with the expression: odd widths, the same bits
// for any number of threads, with inputs for all Gaussians and with tables of them.
#include <algorithm>

#include "bound_changes.h"
#include "checks.h"
#include "expression_change.h"
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

constexpr int64_t kTable = 3;  // rows of a table

// A row of a table for each Gaussian.
std::vector<int64_t> rows_of(int64_t count, Random& random) {
  std::vector<int64_t> rows(count);
  for (int64_t& row : rows) row = random.below(kTable);
  return rows;
}

NetworkResult run(const Sizes& s, bool by_row) {
  Random random(3);
  const int64_t in = s.features + s.own;
  const Floats bases = random.normal(s.count * s.inputs * s.features), neutral = random.normal(s.count * s.features);
  Floats values = random.normal(kTable * s.inputs);
  for (int64_t row = 0; s.inputs > 2 && row < kTable; ++row) values[row * s.inputs + 1] = 0;
  const std::vector<int64_t> rows = rows_of(s.count, random);
  const Floats own = random.normal(s.count * s.own), weight1 = random.normal(s.hidden * in);
  const Floats bias1 = random.normal(s.hidden), weight2 = random.normal(s.width * s.hidden);
  const Floats bias2 = random.normal(s.width);
  const mien::FeatureNetwork network{s.count,      s.features,     s.own,       s.hidden,
                                     s.width,      neutral.data(), own.data(),  weight1.data(),
                                     bias1.data(), weight2.data(), bias2.data()};
  if (!by_row) values.resize(s.inputs);
  const mien::FeatureInputs inputs{bases.data(), s.inputs, values.data(), by_row ? rows.data() : nullptr};
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
  r.by_weight2.resize(weight2.size()), r.by_bias2.resize(s.width), r.by_inputs.resize(by_row ? 0 : s.inputs);
  r.by_owns.resize(own.size());
  mien::feature_network_backward(
      network, inputs, {features.data(), hidden.data()},
      {by_outputs.data(), by_last.data(), r.by_features.data(), r.by_weight1.data(), r.by_bias1.data(),
       r.by_weight2.data(), r.by_bias2.data(), by_row ? nullptr : r.by_inputs.data(), r.by_owns.data()});
  return r;
}

void check_network() {
  for (const Sizes& sizes : {Sizes{0, 3, 4, 2, 5, 3}, Sizes{1, 1, 1, 0, 1, 1}, Sizes{47, 4, 15, 3, 17, 16},
                             Sizes{49, 2, 16, 27, 64, 49}, Sizes{1700, 5, 33, 1, 9, 18}}) {
    for (bool by_row : {false, true}) {
      mien::set_thread_count(1);
      const NetworkResult serial = run(sizes, by_row);
      CHECK(all_finite(serial.outputs) && all_finite(serial.by_features) && all_finite(serial.by_weight1));
      CHECK(all_finite(serial.by_weight2) && all_finite(serial.by_inputs) && all_finite(serial.by_bias1));
      CHECK(all_finite(serial.by_owns));
      mien::set_thread_count(3);
      CHECK(run(sizes, by_row) == serial);
    }
  }
}

// Adam on factors has the bits of Adam on their product, for any number of threads.
void check_adam() {
  for (int width : {1, 15, 16, 33}) {
    for (bool by_row : {false, true}) {
      mien::set_thread_count(by_row ? 1 : 3);
      Random random(6);
      const int64_t count = 300, columns_count = 5, size = count * columns_count * width;
      Floats values = random.normal(size), first = random.normal(size), second = random.uniform(size);
      Floats plain = values, plain_first = first, plain_second = second, gradient(size);
      const Floats rows = random.normal(count * width), columns = random.normal(kTable * columns_count);
      const std::vector<int64_t> places = rows_of(count, random);
      for (int64_t i = 0; i < size; ++i) {
        const int64_t index = i / (columns_count * width), row = by_row ? places[index] : 0;
        gradient[i] = rows[index * width + i % width] * columns[row * columns_count + i / width % columns_count];
      }
      const mien::FactoredTerm term{rows.data(), columns.data(), by_row ? places.data() : nullptr};
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
             columns = random.normal(kTable * columns_count), other = random.normal(count * width);
      std::fill_n(rows.begin(), 5 * width, 0.0f);
      columns[1] = 0;
      const std::vector<int64_t> places = rows_of(count, random);
      // The third term takes the first away, but for rounding.
      Floats against = rows;
      for (float& value : against) value = -value;
      const mien::FactoredTerm terms[] = {{rows.data(), columns.data(), places.data()},
                                          {other.data(), columns.data()},
                                          {against.data(), columns.data(), places.data()}};
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

Floats table_of(int64_t rank, Random& random) {
  mien::FaceActivations face;
  face.own = {random.normal(11), random.normal(11 * rank * kTable), random.normal(4 * rank * kTable), rank * kTable,
              rank};
  face.head_rest = random.normal(6);
  face.head = {Floats(6), random.normal(6 * 2), random.normal(3 * 2), 2, 2};
  face.shares = random.uniform(kTable * kTable);
  const Floats inputs = random.normal(11), pose = random.normal(6);
  Floats table(kTable * face.width());
  mien::activation_table(face, inputs.data(), pose.data(), table.data());
  return table;
}

// Linear changes as the runtime computes them, then those of training with their gradients.
Floats changes(int64_t count, int64_t rank) {
  Random random(7);
  const int64_t width = rank + 2;
  const Floats table = table_of(rank, random), basis = random.normal(count * 3 * rank);
  const std::vector<int64_t> rows = rows_of(count, random);
  Floats alone(count * 3), offset(count * 3), color(count * 3), opacity(count), means(count * 3), sh(count * 3);
  Floats logits(count), by_basis(basis.size()), by_features(count * 5), by_weight1(7 * 5), by_weight2(4 * 7);
  mien::expression_change({count, 3, rank, width, table.data(), rows.data()}, basis.data(), alone.data());

  const Floats neutral = random.normal(count * 5), bases = random.normal(count * width * 5),
               weight1 = random.normal(35);
  const Floats weight2 = random.normal(28), none(11), raw = random.normal(count * 3), by = random.normal(count * 3);
  const mien::FeatureNetwork network{
      count, 5, 0, 7, 4, neutral.data(), nullptr, weight1.data(), none.data(), weight2.data(), none.data()};
  const mien::ChangeBases own{
      count,        rank,  basis.data(), nullptr,  nullptr,
      table.data(), width, rows.data(),  &network, {bases.data(), width, table.data(), rows.data()}};
  Floats features(count * 5), hidden(count * mien::hidden_stride(7));
  const mien::FeatureKept kept{features.data(), hidden.data()};
  const mien::ChangeSquares squares = mien::change_gaussians(
      own, kept, {raw.data(), raw.data(), raw.data()}, {offset.data(), nullptr, nullptr, color.data(), opacity.data()},
      {means.data(), logits.data(), sh.data()});
  CHECK(alone == offset);
  mien::change_gaussians_backward(own, kept, {offset.data(), nullptr, nullptr, color.data(), opacity.data()},
                                  {{by.data(), by.data(), by.data()},
                                   {},
                                   3.0f,
                                   0.1f,
                                   by_basis.data(),
                                   nullptr,
                                   nullptr,
                                   by_features.data(),
                                   by_weight1.data(),
                                   by_weight2.data()});
  Floats all{static_cast<float>(squares.linear), static_cast<float>(squares.features)};
  for (const Floats* each : {&alone, &means, &logits, &sh, &by_basis, &by_features, &by_weight1, &by_weight2})
    all.insert(all.end(), each->begin(), each->end());
  return all;
}

void check_changes() {
  for (int64_t count : {1, 5, 9000}) {
    for (int64_t rank : {1, 3, 11}) {
      mien::set_thread_count(1);
      const Floats serial = changes(count, rank);
      CHECK(all_finite(serial));
      mien::set_thread_count(3);
      CHECK(changes(count, rank) == serial);
    }
  }
}

}  // namespace

void check_feature_network() {
  check_changes();
  check_network();
  check_update();
  check_adam();
}

}  // namespace checks
