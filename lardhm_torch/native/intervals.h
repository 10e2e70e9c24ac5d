// Bounds: a number that the log-odds exceed nowhere on an interval of a ray.
//
// Let an interval reach h to both sides of its middle, and d be the distance of the middle's k-th
// center. A cluster is among the k nearest of some point of the interval only if its center is
// within d + 2h of the middle, and among those of all of its points if it is within d - 2h. So the
// log-odds are at most the sum over the former with positive weights, each at its largest, plus that
// over the latter with negative weights, each at its smallest: on a line, both are known exactly.

#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "kernel.h"
#include "search.h"

namespace lardhm {

// Intervals by their middles (N, D), unit directions (N, D), and half lengths h and 2h [m].
template <class T, int D>
struct Intervals {
  std::vector<T> middles, ways, halves, slack;
  std::vector<T> bounds, nearby;  // what is found: log-odds, and distance of the k-th center [m]

  int64_t size() const { return int64_t(halves.size()); }

  void clear() {
    middles.clear(), ways.clear(), halves.clear(), slack.clear();
  }

  void make_room() { bounds.resize(size()), nearby.resize(size()); }
};

constexpr double kRounding = 1e-5;  // share and log-odds added to a bound for float32

template <class T, int D>
struct IntervalVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  using L = Layout<D>;
  const T *positions, *shapes;
  Intervals<T, D>& intervals;

  IntervalVisitor(const Parameters<T, D>& parameters, Intervals<T, D>& intervals_)
      : positions(parameters.positions.data), shapes(parameters.shapes.data),
        intervals(intervals_) {}

  void invalid(int64_t row) override {
    intervals.bounds[row] = -std::numeric_limits<T>::infinity();
    intervals.nearby[row] = 0;
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    V way[D], half, inner, nearby;
    gather(packet, way, half);
    for (int lane = 0; lane < Simd<T>::W; ++lane) nearby[lane] = std::sqrt(packet.farthest[lane]);
    inner = nearby - 2 * half;  // clusters within it answer all along
    inner = inner > 0 ? inner * inner * T(1 - kRounding) : V{};
    V sum = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* center = positions + int64_t(selected.rank[j]) * L::position;
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      const T weight = shape[L::weight];
      const auto shown = mask_of<T>(selected.bits[j]);
      sum += weight > 0 ? largest(packet, way, half, center, shape, shown)
                        : smallest(packet, way, half, inner, center, shape, shown);
    }
    const V size = sum > 0 ? sum : -sum;
    store_rows<T, D>(sum + size * T(kRounding) + T(kRounding), packet, intervals.bounds.data());
    store_rows<T, D>(nearby, packet, intervals.nearby.data());
  }

 private:
  void gather(const Packet<T, D>& packet, V* way, V& half) const {
    for (int lane = 0; lane < Simd<T>::W; ++lane) {
      const int64_t row = packet.row(std::min(lane, packet.lanes - 1));
      for (int d = 0; d < D; ++d) way[d][lane] = intervals.ways[row * D + d];
      half[lane] = intervals.halves[row];
    }
  }

  // z z, z u and u u, with z the whitened offset of the middle and u the whitened direction.
  static void products(const Packet<T, D>& packet, const V* way, const T* center, const T* shape,
                       V& zz, V& zu, V& uu) {
    V z[D], u[D];
    whiten<T, D>(packet, center, shape, z);
    whiten_offset<T, D>(way, shape, u);
    zz = z[0] * z[0], zu = z[0] * u[0], uu = u[0] * u[0];
    for (int d = 1; d < D; ++d) zz += z[d] * z[d], zu += z[d] * u[d], uu += u[d] * u[d];
  }

  // The cluster of positive weight where the interval comes closest to it.
  static V largest(const Packet<T, D>& packet, const V* way, V half, const T* center,
                   const T* shape, typename Simd<T>::I shown) {
    V zz, zu, uu;
    products(packet, way, center, shape, zz, zu, uu);
    V at = -zu / uu;
    at = at < half ? at : half;
    at = at > -half ? at : -half;
    const V squared = zz + at * (2 * zu + at * uu) - zz * T(kRounding);
    return shown ? exp_of<T>(T(-0.5) * at_least(squared)) * shape[Layout<D>::weight] : V{};
  }

  // The cluster of negative weight at the farther end, where it answers all along.
  static V smallest(const Packet<T, D>& packet, const V* way, V half, V inner, const T* center,
                    const T* shape, typename Simd<T>::I shown) {
    V zz, zu, uu, distance = {};
    for (int d = 0; d < D; ++d) {
      const V offset = packet.x[d] - center[d];
      distance += offset * offset;
    }
    const auto always = shown & (distance < inner);
    products(packet, way, center, shape, zz, zu, uu);
    const V squared = zz + half * (2 * (zu < 0 ? -zu : zu) + half * uu);
    return always ? exp_of<T>(T(-0.5) * squared) * shape[Layout<D>::weight] : V{};
  }

  static V at_least(V squared) { return squared > 0 ? squared : V{}; }
};

}  // namespace lardhm
