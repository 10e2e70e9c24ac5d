// Rays against a map: the first obstacle along each, as `raycasting.py` defines it.

#include "rays.h"

namespace lardhm {
namespace {

constexpr int kBisections = 16;        // as in raycasting.py
constexpr int kVertices = 2;           // parabolas, each a quarter as wide as the one before

// Log-odds of the threshold, beside those of an obstacle; whether to go on to the ridge.
struct March : Steps {
  double level;
  bool ridge;
};

enum class Phase : int8_t { search, climb, vertex, back, bisect };

// A ray on its way to the first obstacle.
template <class T, int D>
struct Cast : Ray<T, D> {
  using Ray<T, D>::place, Ray<T, D>::next, Ray<T, D>::stop, Ray<T, D>::skips, Ray<T, D>::done;
  int64_t clear = -1, ridge = 0;  // the first step that is surely occupied; the highest one
  double best = -kInfinity, low = 0, high = 0, goal = 0;
  int round = 0;
  Phase phase = Phase::search;

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
    }
    return 0;
  }

  void take_search(const March& march, const T* values) {
    int first = 0;
    while (first < kStride && !(values[first] > march.target)) ++first;
    if (next + first >= stop || first == kStride) {
      next += kStride;
      done = next >= stop;
      skips = true;
      return;
    }
    clear = next + first;
    if (march.level == march.target) {  // the step itself is asked for
      high = march.depth(clear);
      done = true;
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
    if (++round == kVertices) done = true;
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
    if (++round == kBisections) done = true;
  }

  // Where the obstacle is; infinite if there is none.
  double result(const March&) const { return clear < 0 ? kInfinity : high; }
};

Tensor raycast(const Tensor& given_origins, const Tensor& given_ways, double step,
               double max_range, double level, double target, bool ridge, const Tensor& centers,
               const Tensor& raw, const Tensor& weights, int64_t k, double covariance_scale,
               double min_lengthscale, const Tensor& index) {
  check_k(k);
  const Tensor origins = tidy(given_origins), ways = tidy(given_ways);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  const int64_t n = origins.size(0);
  const March march{{step, max_range, target}, level, ridge};
  check_rays(origins, ways, centers);
  check_steps(march);
  k = std::min(k, centers.size(0));
  const Tensor results = new_empty(origins, {n});
  if (k == 0) return fill(results, kInfinity);
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_parameters<T, dim()>(map, kStride * n, [&](Parameters<T, dim()>& parameters) {
      march_all<T, dim(), Cast<T, dim()>>(in<double>(origins), in<double>(ways), n, map, k, march,
                                          parameters, out<double>(results));
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
