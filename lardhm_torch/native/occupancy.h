// Log-odds or probability of every point, as written by queries.

#pragma once

#include <cstdint>
#include <limits>

#include "kernel.h"
#include "search.h"

namespace lardhm {

template <class T, int D>
struct OccupancyVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  const T *positions, *shapes;
  bool probability;
  T* out;

  OccupancyVisitor(const Parameters<T, D>& parameters, bool probability_, T* out_)
      : positions(parameters.positions.data), shapes(parameters.shapes.data),
        probability(probability_), out(out_) {}

  void invalid(int64_t row) override { out[row] = std::numeric_limits<T>::quiet_NaN(); }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    using L = Layout<D>;
    V sum = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      const T* center = positions + int64_t(selected.rank[j]) * L::position;
      const V term = feature_of<T, D>(packet, center, shape) * shape[L::weight];
      sum = mask_of<T>(selected.bits[j]) ? sum + term : sum;
    }
    store_rows<T, D>(probability ? sigmoid<T>(sum) : sum, packet, out);
  }
};

}  // namespace lardhm
