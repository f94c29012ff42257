// A gradient that is a sum of outer products, as Python gives it: a list of rows [n, f], one of columns [k], or of
// tables of columns [.., k], and one of places in these tables [n], or none.
#pragma once

#include <vector>

#include "arrays.h"
#include "feature_network.h"

constexpr int64_t kMostWidth = 1 << 20;  // so that products of widths fit
constexpr size_t kMostTerms = 1 << 10;

struct FactoredTerms {
  std::vector<mien::FactoredTerm> terms;
  int columns_count, width;

  // Of values [n, k, f]. The arrays have to live as long as this does.
  FactoredTerms(const Out<-1, -1, -1>& values, const std::vector<In<-1, -1>>& rows,
                const std::vector<In<-1, -1>>& columns, const std::vector<std::optional<Rows>>& places) {
    const size_t count = values.shape(0), inputs = values.shape(1), numbers = values.shape(2);
    require(rows.size() == columns.size() && places.size() == rows.size() && rows.size() <= kMostTerms,
            "every term needs rows, columns and places");
    for (size_t i = 0; i < rows.size(); ++i) {
      require(has_shape(rows[i], count, numbers) && columns[i].shape(1) == inputs, "factors must fit the values");
      terms.push_back({rows[i].data(), columns[i].data(), checked_rows(places[i], count, columns[i].shape(0))});
    }
    columns_count = checked_length(inputs, kMostWidth, "inputs");
    width = checked_length(numbers, kMostWidth, "numbers in a row");
  }
};
