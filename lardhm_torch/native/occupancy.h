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

  bool wants_bits() const override { return false; }

  void invalid(int64_t row) override { out[row] = std::numeric_limits<T>::quiet_NaN(); }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    const V sum = packet.all_fade ? faded_sum(packet, selected) : selected_sum(packet, selected);
    store_rows<T, D>(probability ? sigmoid<T>(sum) : sum, packet, out);
  }

  V selected_sum(const Packet<T, D>& packet, const Selection& selected) const {
    using L = Layout<D>;
    V sum = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      const T* center = positions + int64_t(selected.rank[j]) * L::position;
      const V term = feature_of<T, D>(packet, center, shape);
      sum = mask_of<T>(selected.bits[j]) ? sum + term * shape[L::weight] : sum;
    }
    return sum;
  }

  // The same where a center at the k-th distance has no weight.
  V faded_sum(const Packet<T, D>& packet, const Selection& selected) const {
    using L = Layout<D>;
    V sum = {}, z[D];
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      whiten<T, D>(packet, positions + int64_t(selected.rank[j]) * L::position, shape, z);
      const V t = packet.squared[j] * packet.fading;
      const V term = kernel_of<T, D>(z) * fade_within<T>(t);
      sum = t < T(1) ? sum + term * shape[L::weight] : sum;
    }
    return sum;
  }
};

}  // namespace lardhm
