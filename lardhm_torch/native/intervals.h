// Bounds: numbers that the log-odds exceed nowhere on each quarter of an interval of a ray.
//
// Let an interval reach h to both sides of its middle, and d be the distance of the middle's k-th
// center. A cluster is among the k nearest of some point of the interval only if its center is
// within d + 2h of the middle, and among those of all of its points if it is within d - 2h. So the
// log-odds are at most the sum over the former with positive weights, each at its largest, plus that
// over the latter with negative weights, each at its smallest: on a line, both are known exactly.
// Bounds of the fade follow from the same distances.

#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "kernel.h"
#include "search.h"

namespace lardhm {

constexpr int kQuarters = 4;

// Intervals by their middles (N, D), unit directions (N, D), and half lengths h and 2h [m].
template <class T, int D>
struct Intervals {
  std::vector<T> middles, ways, halves, slack;
  std::vector<T> bounds, nearby;  // what is found: (N, 4), and distance of the k-th center (N,) [m]

  int64_t size() const { return int64_t(halves.size()); }

  void clear() { middles.clear(), ways.clear(), halves.clear(), slack.clear(); }

  void make_room() { bounds.resize(kQuarters * size()), nearby.resize(size()); }
};

constexpr double kRounding = 1e-5;  // fraction and log-odds added to a bound for float32
constexpr double kNegligible = 60;  // squared whitened distance beyond which a cluster adds 1e-13

template <class T, int D>
struct IntervalVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  using L = Layout<D>;
  static constexpr int W = Simd<T>::W;
  const T *positions, *shapes;
  Intervals<T, D>& intervals;

  IntervalVisitor(const Parameters<T, D>& parameters, Intervals<T, D>& intervals_)
      : positions(parameters.positions.data), shapes(parameters.shapes.data),
        intervals(intervals_) {}

  void invalid(int64_t row) override {
    for (int i = 0; i < kQuarters; ++i)
      intervals.bounds[row * kQuarters + i] = -std::numeric_limits<T>::infinity();
    intervals.nearby[row] = 0;
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    V way[D], half, inner, nearby, sum[kQuarters] = {};
    gather(packet, way, half);
    for (int lane = 0; lane < W; ++lane) nearby[lane] = std::sqrt(packet.farthest[lane]);
    inner = nearby - 2 * half;  // clusters within it contribute everywhere
    inner = inner > 0 ? inner * inner * T(1 - kRounding) : V{};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* center = positions + int64_t(selected.rank[j]) * L::position;
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      const I shown = mask_of<T>(selected.bits[j]);
      const V squared = squared_distance(packet, center);
      const bool adds = shape[L::weight] > 0;
      const V weight = shape[L::weight] * fade_within(packet, squared, nearby, adds ? half : -half);
      if (adds)
        add_largest(packet, way, half, center, shape, weight, shown, sum);
      else
        add_smallest(packet, way, half, center, shape, weight, shown & (squared < inner), sum);
    }
    store_rows<T, D>(nearby, packet, intervals.nearby.data());
    for (int lane = 0; lane < packet.lanes; ++lane)
      for (int i = 0; i < kQuarters; ++i)
        intervals.bounds[packet.row(lane) * kQuarters + i] =
            sum[i][lane] + std::abs(sum[i][lane]) * T(kRounding) + T(kRounding);
  }

 private:
  void gather(const Packet<T, D>& packet, V* way, V& half) const {
    for (int lane = 0; lane < W; ++lane) {
      const int64_t row = packet.row(std::min(lane, packet.lanes - 1));
      for (int d = 0; d < D; ++d) way[d][lane] = intervals.ways[row * D + d];
      half[lane] = intervals.halves[row];
    }
  }

  static V squared_distance(const Packet<T, D>& packet, const T* center) {
    V distance = {};
    for (int d = 0; d < D; ++d) {
      const V offset = packet.x[d] - center[d];
      distance += offset * offset;
    }
    return distance;
  }

  // The largest fade within `half` of the middle or, for a negative one, the smallest: nowhere is a
  // center nearer, or the k-th farther, by more than that.
  static V fade_within(const Packet<T, D>& packet, V squared, V nearby, V half) {
    V share = {};
    for (int lane = 0; lane < packet.lanes; ++lane) {
      if (packet.fading[lane] == 0) continue;
      const T distance = std::max(std::sqrt(squared[lane]) - half[lane], T(0));
      const T farthest = std::max(nearby[lane] + half[lane], std::numeric_limits<T>::min());
      share[lane] = distance / farthest * (half[lane] > 0 ? T(1 - kRounding) : T(1 + kRounding));
    }
    return fade_of<T>(share * share);
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

  // Adds weight exp(-squared / 2) in the lanes that are shown; false if all are negligible.
  static void add(V squared, V weight, I shown, V& sum) {
    const I seen = shown & (squared < T(kNegligible));
    if (!bits_of<T>(seen)) return;
    sum += seen ? exp_of<T>(T(-0.5) * squared) * weight : V{};
  }

  // A cluster of positive weight, where each quarter comes closest to it.
  static void add_largest(const Packet<T, D>& packet, const V* way, V half, const T* center,
                          const T* shape, V weight, I shown, V* sum) {
    V zz, zu, uu;
    products(packet, way, center, shape, zz, zu, uu);
    const V closest = -zu / uu;
    zz -= zz * T(kRounding);
    for (int i = 0; i < kQuarters; ++i) {
      const V low = half * T(i * 2.0 / kQuarters - 1), high = low + half * T(2.0 / kQuarters);
      V at = closest < high ? closest : high;
      at = at > low ? at : low;
      const V squared = zz + at * (2 * zu + at * uu);
      add(squared > 0 ? squared : V{}, weight, shown, sum[i]);
    }
  }

  // A cluster of negative weight, at the farther end of each quarter.
  static void add_smallest(const Packet<T, D>& packet, const V* way, V half, const T* center,
                           const T* shape, V weight, I shown, V* sum) {
    if (!bits_of<T>(shown)) return;
    V zz, zu, uu;
    products(packet, way, center, shape, zz, zu, uu);
    for (int i = 0; i < kQuarters; ++i) {
      const V low = half * T(i * 2.0 / kQuarters - 1), high = low + half * T(2.0 / kQuarters);
      const V first = zz + low * (2 * zu + low * uu), end = zz + high * (2 * zu + high * uu);
      add(first > end ? first : end, weight, shown, sum[i]);
    }
  }
};

}  // namespace lardhm
