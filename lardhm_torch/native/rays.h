// Many rays that advance together through a map, a few steps at a time.
//
// In every round each ray passes over the clear cells ahead, and then asks for the log-odds at its next
// steps. The requests of all rays are answered in packets of neighboring points.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "clear_cells.h"
#include "occupancy.h"
#include "sorting.h"
#include "tensors.h"

namespace lardhm {

constexpr int kStride = 4;          // steps whose log-odds are evaluated at a time; of a leaf
constexpr int kLargestCell = 4;     // leaves along an edge of the largest cells that are bounded
constexpr int kAround = 16;         // and of a cube that would hold k evenly spread clusters, or more
constexpr double kAhead = 0.1;      // of the longest range, where rays are sorted by place
constexpr int64_t kWave = 1 << 15;  // rays that advance together
constexpr double kInfinity = std::numeric_limits<double>::infinity();

// Steps of a ray: their length and the largest range [m]; steps whose log-odds do not exceed a target
// may be passed over.
struct Steps {
  double step, max_range, target;

  int64_t last() const { return int64_t(std::ceil(max_range / step - 1e-9)); }
  double depth(int64_t n) const { return std::min(double(n) * step, max_range); }
};

// A ray. What derives from it defines
//   void ask(const March&, std::vector<T>& points) const: the points whose log-odds it needs,
//   int take(const March&, const T* values): receives them, and returns their number,
//   double result(const March&) const.
template <class T, int D>
struct Ray {
  double origin[D], way[D], inverse[D];
  int64_t row, next = 0, stop = 0;  // the next step, and the one from which on none reaches the target
  bool skips = true, done = false;  // whether clear cells are passed over next; whether it is at its end

  void place(double depth, std::vector<T>& to) const {
    for (int d = 0; d < D; ++d) to.push_back(T(origin[d] + depth * way[d]));
  }

  // The steps inside the box outside of which nothing reaches the target.
  void clip(const Box<double, D>& box, const Steps& steps) {
    double first = 0, end = steps.max_range;
    bool inside = true;
    for (int d = 0; d < D; ++d) {
      inverse[d] = 1 / way[d];
      if (way[d] == 0) inside &= origin[d] >= box.low[d] && origin[d] <= box.high[d];
      const double a = (box.low[d] - origin[d]) * inverse[d];
      const double b = (box.high[d] - origin[d]) * inverse[d];
      if (std::isnan(a) || std::isnan(b)) continue;  // along a side
      first = std::max(first, std::min(a, b));
      end = std::min(end, std::max(a, b));
    }
    inside &= first <= end;
    next = inside ? int64_t(first / steps.step) : 0;
    stop = inside ? std::min(steps.last(), int64_t(std::ceil(end / steps.step))) + 1 : 0;
    done = next >= stop;
  }

  // Passes over the clear cells ahead; false where it must wait for the bound of one.
  bool skip(const Steps& steps, ClearCells<T, D>& cells) {
    while (next < stop) {
      const double depth = steps.depth(next);
      double point[D], low[D], high[D], leaves = kInfinity;
      for (int d = 0; d < D; ++d) point[d] = origin[d] + depth * way[d];
      const auto place = cells.find(point, low, high);
      if (place == ClearCells<T, D>::Place::waiting) return false;
      skips = place == ClearCells<T, D>::Place::clear;
      if (!skips) return true;
      for (int d = 0; d < D; ++d)
        if (way[d] != 0)
          leaves = std::min(leaves, ((way[d] > 0 ? high : low)[d] - origin[d]) * inverse[d]);
      next = std::max(next, int64_t(std::min(leaves / steps.step, 1e15))) + 1;
    }
    done = true;
    return false;
  }
};

// A box, map frame, outside of which no log-odds reach the target: at most k clusters contribute, so
// one of them must reach 1/k of it.
template <class T, int D>
Box<double, D> obstacle_box(const MapTensors& map, int64_t k, double target) {
  Box<double, D> box;
  const double scale = std::sqrt(map.scaling.covariance_scale) * (1 + kRounding);
  for (int64_t row = 0; row < map.centers.size(0); ++row) {
    const double share = double(in<T>(map.weights)[row]) * double(k) / target;
    if (!(share > 1 - kRounding)) continue;
    const double extent = std::sqrt(2 * std::log(std::max(share, 1.0)) + kRounding);
    const T* factor = in<T>(map.raw) + row * D * D;
    for (int d = 0; d < D; ++d) {
      const double diagonal = std::max(std::exp(double(factor[d * D + d])),
                                       map.scaling.min_lengthscale);
      double squared = diagonal * diagonal;
      for (int c = 0; c < d; ++c) squared += double(factor[d * D + c]) * double(factor[d * D + c]);
      const double reach = extent * scale * std::sqrt(squared);
      box.low[d] = std::min(box.low[d], double(in<T>(map.centers)[row * D + d]) - reach);
      box.high[d] = std::max(box.high[d], double(in<T>(map.centers)[row * D + d]) + reach);
    }
  }
  return box;
}

// One wave of rays, from start to end.
template <class T, int D, class Each, class March>
struct Wave {
  const Parameters<T, D>& parameters;
  const March& march;
  Search<T, D> search;
  ClearCells<T, D> cells;
  std::vector<Each> rays;
  std::vector<int64_t> asking;  // rays of a round
  std::vector<T> points, values;

  Wave(Parameters<T, D>& parameters_, int64_t k, const March& march_, const Box<double, D>& box)
      : parameters(parameters_), march(march_), search(parameters_, k),
        cells(box, leaf(parameters_.index.header, k, march_.step), kLargestCell, march_.target) {}

  void run(double* results) {
    for (;;) {
      int64_t kept = 0;
      for (const Each& ray : rays) {
        if (ray.done)
          results[ray.row] = ray.result(march);
        else
          rays[kept++] = ray;
      }
      rays.resize(kept);
      if (kept == 0) return;
      round();
    }
  }

 private:
  // Edge of the leaves [m]: a few steps, but not tiny ones compared with the distances of clusters.
  static double leaf(const Header& header, int64_t k, double step) {
    double volume = double(k) / double(header.count);
    for (int d = 0; d < D; ++d) volume *= header.high[d] - header.low[d];
    return std::max(kStride * step, std::pow(volume, 1.0 / D) / kAround);
  }

  void round() {
    points.clear(), asking.clear();
    for (int64_t i = 0; i < int64_t(rays.size()); ++i) {
      if (rays[i].skips && !rays[i].skip(march, cells)) continue;
      rays[i].ask(march, points);
      asking.push_back(i);
    }
    cells.answer(search, parameters);
    const int64_t n = int64_t(points.size()) / D;
    values.resize(n);
    OccupancyVisitor<T, D> visitor(parameters, false, values.data());
    search.visit(points.data(), nullptr, n, visitor);
    const T* value = values.data();
    for (int64_t i : asking) value += rays[i].take(march, value);
  }
};

// An order of the rays in which neighbors have similar origins and directions.
template <int D>
std::vector<uint64_t> sorted_rays(const double* origins, const double* ways, int64_t n,
                                  double ahead) {
  std::vector<double> places(n * D);
  for (int64_t i = 0; i < n * D; ++i) {
    const double place = origins[i] + ahead * ways[i];
    places[i] = std::isfinite(place) ? place : 0.0;
  }
  Box<double, D> box;
  box.add(places.data(), 0, n, 1);
  double edges[D];
  for (int d = 0; d < D; ++d) edges[d] = box.high[d] - box.low[d];
  Sorter sorter;
  ZCurve<D>(edges, double(n)).sort(places.data(), box.low, n, sorter);
  return sorter.items;
}

// Rays (R, D) float64 in the map's frame -> one result each; no map has fewer than one cluster.
template <class T, int D, class Each, class March>
void march_all(const double* origins, const double* ways, int64_t n, const MapTensors& map,
               int64_t k, const March& march, Parameters<T, D>& parameters, double* results) {
  const Header& header = parameters.index.header;
  Box<double, D> clip, box;
  for (int d = 0; d < D; ++d) clip.low[d] = -kInfinity, clip.high[d] = kInfinity;
  if (march.target > 0) clip = obstacle_box<T, D>(map, k, march.target);
  for (int d = 0; d < D; ++d) {
    box.low[d] = march.target > 0 ? clip.low[d] : header.low[d];
    box.high[d] = march.target > 0 ? clip.high[d] : header.high[d];
  }
  const auto order = sorted_rays<D>(origins, ways, n, kAhead * march.max_range);
  const int64_t threads = parameters.packed.empty() ? num_threads() : 1;
  const int64_t size = std::min(kWave, (n + threads - 1) / threads);
  run_tasks((n + size - 1) / size, [&](int64_t task) {
    Wave<T, D, Each, March> wave(parameters, k, march, box);
    for (int64_t i = task * size; i < std::min(n, (task + 1) * size); ++i) {
      Each ray;
      ray.row = uint32_t(order[i]);
      for (int d = 0; d < D; ++d) {
        ray.origin[d] = origins[ray.row * D + d];
        ray.way[d] = ways[ray.row * D + d];
      }
      ray.clip(clip, march);
      wave.rays.push_back(ray);
    }
    wave.run(results);
  });
}

inline void check_rays(const Tensor& origins, const Tensor& ways, const Tensor& centers) {
  for (const Tensor* rays : {&origins, &ways})
    check(rays->dim() == 2 && rays->size(0) == origins.size(0) &&
              rays->size(1) == centers.size(1) && rays->scalar_type() == ScalarType::Double,
          "origins and directions must be (R, D) float64");
}

inline void check_steps(const Steps& steps) {
  check(steps.step > 0 && steps.max_range > 0 && steps.max_range < 1e15 * steps.step,
        "step and max_range must be > 0");
}

}  // namespace lardhm
