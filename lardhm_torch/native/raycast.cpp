// Rays against a map: the first obstacle along each, as `rays.py` defines it.
//
// Many rays advance together. In every round each ray requests one of two things: a bound for the
// interval of steps ahead, which is skipped if the bound is too low and halved otherwise; or the
// log-odds at a few points, if a short interval could not be skipped, and to locate the ridge or the
// crossing. The requests of all rays are answered in packets of neighboring points.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "intervals.h"
#include "occupancy.h"
#include "sorting.h"
#include "tensors.h"

namespace lardhm {
namespace {

constexpr int kStride = 4;             // steps of the shortest interval, whose log-odds are evaluated
constexpr int kFirst = 32;             // steps of the first interval
constexpr double kShare = 1;           // most of half an interval over the distance of the k-th center
constexpr int kBisections = 16;        // as in rays.py
constexpr int kVertices = 2;           // parabolas, each a quarter as wide as the one before
constexpr double kAhead = 0.1;         // of the longest range, where rays are sorted by place
constexpr int64_t kWave = 1 << 15;     // rays that advance together
constexpr double kInfinity = std::numeric_limits<double>::infinity();

// Parameters: step [m], maximum range [m], log-odds of the threshold and of an obstacle.
struct March {
  double step, max_range, level, target;
  bool ridge;

  int64_t last() const { return int64_t(std::ceil(max_range / step - 1e-9)); }
  double depth(int64_t n) const { return std::min(double(n) * step, max_range); }
};

enum class Phase : int8_t { skip, search, climb, vertex, back, bisect, done };

// One ray and its state.
template <class T, int D>
struct Ray {
  double origin[D], way[D];
  int64_t row, next, stop;  // the next step, and the one from which on there is no obstacle
  int64_t length = kFirst;  // steps of the next interval
  int64_t clear = -1, ridge = 0;  // the first step that is surely occupied; the highest one
  double best = -kInfinity, low = 0, high = 0, goal = 0;
  int round = 0;
  Phase phase = Phase::skip;

  void place(double depth, std::vector<T>& to) const {
    for (int d = 0; d < D; ++d) to.push_back(T(origin[d] + depth * way[d]));
  }

  void ask_bound(const March& march, Intervals<T, D>& intervals) const {
    const double first = march.depth(next), half = 0.5 * march.step * double(length - 1);
    place(first + half, intervals.middles);
    for (int d = 0; d < D; ++d) intervals.ways.push_back(T(way[d]));
    intervals.halves.push_back(T(half * (1 + kRounding)));
    intervals.slack.push_back(T(2 * half * (1 + kRounding)));
  }

  // Skips the quarters in which there is no obstacle.
  void take_bound(const March& march, const T* bounds, double nearby) {
    int passed = 0;
    while (passed < kQuarters && bounds[passed] <= march.target) ++passed;
    next += passed * length / kQuarters;
    if (next >= stop) {
      phase = Phase::done;
    } else if (passed == kQuarters) {
      const double most = std::min(2 * kShare * nearby / march.step, 1e9);
      length = std::clamp<int64_t>(int64_t(most) / kQuarters * kQuarters, kQuarters, 2 * length);
    } else if (length == kQuarters) {
      phase = Phase::search;
    } else {
      length = std::max<int64_t>(kQuarters, length / kQuarters / kQuarters * kQuarters);
    }
  }

  // The points whose log-odds are needed next.
  void ask(const March& march, std::vector<T>& points) const {
    if (phase == Phase::search || phase == Phase::climb)
      for (int i = 0; i < kStride; ++i) place(march.depth(next + i), points);
    if (phase == Phase::back)
      for (int i = 0; i < kStride; ++i)
        place(march.depth(std::max<int64_t>(next - kStride + i, 0)), points);
    if (phase == Phase::vertex)
      for (int side = -1; side <= 1; ++side)
        place(std::clamp(high + side * low, 0.0, march.max_range), points);
    if (phase == Phase::bisect) place(0.5 * (low + high), points);
  }

  // Receives the log-odds of the requested points; returns their number.
  int take(const March& march, const T* values) {
    switch (phase) {
      case Phase::search: take_search(march, values); return kStride;
      case Phase::climb: climb(march, values, 0); return kStride;
      case Phase::back: take_back(march, values); return kStride;
      case Phase::vertex: take_vertex(march, values); return 3;
      case Phase::bisect: take_bisect(values[0]); return 1;
      default: return 0;
    }
  }

  void take_search(const March& march, const T* values) {
    int first = 0;
    while (first < kStride && !(values[first] > march.target)) ++first;
    if (next + first >= stop || first == kStride) {
      next += kStride;
      length = 2 * kStride;
      phase = next >= stop ? Phase::done : Phase::skip;
      return;
    }
    clear = next + first;
    if (march.level == march.target) {  // the step itself is asked for
      high = march.depth(clear);
      phase = Phase::done;
      return;
    }
    if (march.ridge) return climb(march, values, first);
    next = clear;
    high = march.depth(clear);
    phase = Phase::back;
    if (clear == 0) start_unknown(march);
  }

  // Advances to the largest log-odds before they fall by 1.
  void climb(const March& march, const T* values, int first) {
    phase = Phase::climb;
    for (int i = first; i < kStride && next + i <= march.last(); ++i) {
      if (values[i] >= best) best = values[i], ridge = next + i;
      if (values[i] < best - (march.target - march.level)) return start_vertex(march);
    }
    next += kStride;
    if (next > march.last()) start_vertex(march);
  }

  void start_vertex(const March& march) {
    high = march.depth(ridge);
    low = march.step;  // the width
    round = 0;
    phase = Phase::vertex;
  }

  // Moves to the vertex of the parabola through three log-odds.
  void take_vertex(const March& march, const T* values) {
    const double before = values[0], here = values[1], after = values[2];
    const double bend = before - 2 * here + after;
    const double shift = bend < 0 ? std::clamp(0.5 * (before - after) / bend, -1.0, 1.0) : 0.0;
    high = std::clamp(high + low * shift, 0.0, march.max_range);
    low /= 4;
    if (++round == kVertices) phase = Phase::done;
  }

  // Moves back to the last step below the level.
  void take_back(const March& march, const T* values) {
    for (int i = kStride - 1; i >= 0; --i) {
      const int64_t n = next - kStride + i;
      if (n < 0 || !(values[i] <= march.level)) continue;
      low = march.depth(n), goal = march.level;
      phase = Phase::bisect;
      return;
    }
    next -= kStride;
    if (next <= 0) start_unknown(march);
  }

  // Never below the level: it is met where it gets clear.
  void start_unknown(const March& march) {
    low = std::max(high - march.step, 0.0), goal = march.target;
    phase = Phase::bisect;
  }

  void take_bisect(double value) {
    (value > goal ? high : low) = 0.5 * (low + high);
    if (++round == kBisections) phase = Phase::done;
  }

  // Where the obstacle is; infinite if there is none.
  double result() const { return clear < 0 ? kInfinity : high; }
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

// The steps of a ray inside the box; none where it passes by.
template <class T, int D>
void clip(Ray<T, D>& ray, const Box<double, D>& box, const March& march) {
  double first = 0, end = march.max_range;
  for (int d = 0; d < D; ++d) {
    const double a = (box.low[d] - ray.origin[d]) / ray.way[d];
    const double b = (box.high[d] - ray.origin[d]) / ray.way[d];
    if (std::isnan(a) || std::isnan(b)) continue;  // along a side
    first = std::max(first, std::min(a, b));
    end = std::min(end, std::max(a, b));
  }
  bool inside = first <= end;
  for (int d = 0; d < D; ++d)
    inside &= ray.way[d] != 0 || (ray.origin[d] >= box.low[d] && ray.origin[d] <= box.high[d]);
  ray.next = inside ? int64_t(first / march.step) : 0;
  ray.stop = inside ? std::min(march.last(), int64_t(std::ceil(end / march.step))) + 1 : 0;
  if (ray.next >= ray.stop) ray.phase = Phase::done;
}

// One wave of rays, from start to end.
template <class T, int D>
struct Wave {
  const Parameters<T, D>& parameters;
  const March& march;
  Search<T, D> search;
  std::vector<Ray<T, D>> rays;
  Intervals<T, D> intervals;
  std::vector<T> points, values;

  Wave(Parameters<T, D>& parameters_, int64_t k, const March& march_)
      : parameters(parameters_), march(march_), search(parameters_, k) {}

  void run(double* results) {
    for (;;) {
      int64_t kept = 0;
      for (const Ray<T, D>& ray : rays) {
        if (ray.phase == Phase::done)
          results[ray.row] = ray.result();
        else
          rays[kept++] = ray;
      }
      rays.resize(kept);
      if (kept == 0) return;
      round();
    }
  }

 private:
  void round() {
    intervals.clear(), points.clear();
    for (const Ray<T, D>& ray : rays)
      ray.phase == Phase::skip ? ray.ask_bound(march, intervals) : ray.ask(march, points);
    bound();
    evaluate();
    int64_t interval = 0;
    const T* value = values.data();
    for (Ray<T, D>& ray : rays) {
      if (ray.phase == Phase::skip) {
        ray.take_bound(march, intervals.bounds.data() + interval * kQuarters,
                       intervals.nearby[interval]);
        ++interval;
      } else {
        value += ray.take(march, value);
      }
    }
  }

  void bound() {
    intervals.make_room();
    IntervalVisitor<T, D> visitor(parameters, intervals);
    search.visit(intervals.middles.data(), intervals.slack.data(), intervals.size(), visitor);
  }

  void evaluate() {
    const int64_t n = int64_t(points.size()) / D;
    values.resize(n);
    OccupancyVisitor<T, D> visitor(parameters, false, values.data());
    search.visit(points.data(), nullptr, n, visitor);
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

template <class T, int D>
void march_all(const double* origins, const double* ways, int64_t n, const MapTensors& map,
               int64_t k, const March& march, Parameters<T, D>& parameters, double* results) {
  Box<double, D> box;
  for (int d = 0; d < D; ++d) box.low[d] = -kInfinity, box.high[d] = kInfinity;
  if (march.target > 0) box = obstacle_box<T, D>(map, k, march.target);
  const auto order = sorted_rays<D>(origins, ways, n, kAhead * march.max_range);
  const int64_t threads = parameters.packed.empty() ? num_threads() : 1;
  const int64_t size = std::min(kWave, (n + threads - 1) / threads);
  run_tasks((n + size - 1) / size, [&](int64_t task) {
    Wave<T, D> wave(parameters, k, march);
    for (int64_t i = task * size; i < std::min(n, (task + 1) * size); ++i) {
      Ray<T, D> ray;
      ray.row = uint32_t(order[i]);
      for (int d = 0; d < D; ++d) {
        ray.origin[d] = origins[ray.row * D + d];
        ray.way[d] = ways[ray.row * D + d];
      }
      clip(ray, box, march);
      wave.rays.push_back(ray);
    }
    wave.run(results);
  });
}

Tensor raycast(const Tensor& given_origins, const Tensor& given_ways, double step,
               double max_range, double level, double target, bool ridge, const Tensor& centers,
               const Tensor& raw, const Tensor& weights, int64_t k, double covariance_scale,
               double min_lengthscale, const Tensor& index) {
  check_k(k);
  const Tensor origins = tidy(given_origins), ways = tidy(given_ways);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  const int64_t n = origins.size(0);
  for (const Tensor* rays : {&origins, &ways})
    check(rays->dim() == 2 && rays->size(0) == n && rays->size(1) == centers.size(1) &&
              rays->scalar_type() == ScalarType::Double,
          "origins and directions must be (R, D) float64");
  check(step > 0 && max_range > 0 && max_range < 1e15 * step,
        "step and max_range must be > 0");
  k = std::min(k, centers.size(0));
  const Tensor results = new_empty(origins, {n});
  if (k == 0) return fill(results, kInfinity);
  const March march{step, max_range, level, target, ridge};
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_parameters<T, dim()>(map, kStride * n, [&](Parameters<T, dim()>& parameters) {
      march_all<T, dim()>(in<double>(origins), in<double>(ways), n, map, k, march, parameters,
                          out<double>(results));
    });
    return 0;
  });
  return results;
}

}  // namespace

std::vector<Operator> raycast_operators() {
  return {
      {"raycast(Tensor origins, Tensor directions, float step, float max_range, float level, "
       "float target, bool ridge, Tensor centers, Tensor raw_scale_tril, Tensor weights, int k, "
       "float covariance_scale, float min_lengthscale, Tensor index) -> Tensor",
       &boxed<raycast>},
  };
}

}  // namespace lardhm
