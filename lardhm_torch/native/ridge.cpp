// The ridge behind a surface, as `ridge.ridge_positions` defines it, and means over a mesh's neighbors.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "occupancy.h"
#include "tensors.h"

namespace lardhm {
namespace {

constexpr int64_t kTogether = 1024;  // lines searched at a time, neighbors after each other
constexpr int kStages = 4;           // steps evaluated at a time

// The first peak along one line: the largest value before they fall by so much.
struct Climb {
  int64_t row;
  int peak = 0;
  double best = -std::numeric_limits<double>::infinity(), before = 0, after = 0, last = 0;
  bool fallen = false;

  void take(int step, double value, double fall) {
    if (fallen) return;
    if (step == peak + 1) after = value;
    if (value >= best) {
      best = value, peak = step, before = last;
    } else if (value < best - fall) {
      fallen = true;
    }
    last = value;
  }

  // Between steps, from the parabola through three of them; NaN at either end.
  double position(int steps) const {
    if (peak == 0 || peak == steps) return std::numeric_limits<double>::quiet_NaN();
    const double bend = before - 2 * best + after;
    return peak + (bend < 0 ? std::clamp(0.5 * (before - after) / bend, -1.0, 1.0) : 0.0);
  }
};

template <class T, int D>
struct Climber {
  const double *points, *strides;
  int steps;
  double fall;
  Parameters<T, D>& parameters;
  int64_t k;

  void climb(int64_t begin, int64_t end, double* positions) const {
    Search<T, D> search(parameters, k);
    std::vector<Climb> lines(end - begin);
    for (int64_t i = 0; i < end - begin; ++i) lines[i].row = begin + i;
    std::vector<T> places, values;
    for (int first = 0; first <= steps && !lines.empty(); first += kStages) {
      const int count = std::min(kStages, steps + 1 - first);
      places.clear();
      for (const Climb& line : lines)
        for (int step = first; step < first + count; ++step)
          for (int d = 0; d < D; ++d)
            places.push_back(T(points[line.row * D + d] - step * strides[line.row * D + d]));
      values.resize(lines.size() * count);
      OccupancyVisitor<T, D> visitor(parameters, false, values.data());
      search.visit(places.data(), nullptr, int64_t(values.size()), visitor);
      size_t kept = 0;
      for (size_t i = 0; i < lines.size(); ++i) {
        Climb line = lines[i];
        for (int s = 0; s < count; ++s) line.take(first + s, values[i * count + s], fall);
        if (line.fallen || first + count > steps)
          positions[line.row] = line.position(steps);
        else
          lines[kept++] = line;
      }
      lines.resize(kept);
    }
  }
};

Tensor ridge_positions(const Tensor& given_points, const Tensor& given_strides, int64_t steps,
                       double fall, const Tensor& centers, const Tensor& raw,
                       const Tensor& weights, int64_t k, double covariance_scale,
                       double min_lengthscale, const Tensor& index) {
  check_k(k);
  const Tensor points = tidy(given_points), strides = tidy(given_strides);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  const int64_t n = points.size(0);
  for (const Tensor* lines : {&points, &strides})
    check(lines->dim() == 2 && lines->size(0) == n && lines->size(1) == centers.size(1) &&
              lines->scalar_type() == ScalarType::Double,
          "points and strides must be (V, D) float64");
  check(steps >= 2 && steps < 1024, "steps must be 2 to 1023");
  k = std::min(k, centers.size(0));
  const Tensor positions = new_empty(points, {n});
  if (k == 0)
    return fill(positions, std::numeric_limits<double>::quiet_NaN());
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_parameters<T, dim()>(map, n * steps, [&](Parameters<T, dim()>& parameters) {
      const Climber<T, dim()> climber{in<double>(points), in<double>(strides), int(steps), fall,
                                      parameters, k};
      const int64_t tasks = (n + kTogether - 1) / kTogether;
      const auto work = [&](int64_t task) {
        climber.climb(task * kTogether, std::min(n, (task + 1) * kTogether),
                      out<double>(positions));
      };
      if (parameters.packed.empty()) {
        run_tasks(tasks, work);
      } else {  // parameters are packed on the way, by one thread
        for (int64_t task = 0; task < tasks; ++task) work(task);
      }
    });
    return 0;
  });
  return positions;
}

// As `ridge.mean_with_neighbors`.
Tensor mean_with_neighbors(const Tensor& given_values, const Tensor& given_faces) {
  const Tensor values = tidy(given_values), faces = tidy(given_faces);
  check(values.dim() == 2 && values.scalar_type() == ScalarType::Double,
        "values must be (V, C) float64");
  check(faces.dim() == 2 && faces.size(1) == 3 && faces.scalar_type() == ScalarType::Long,
        "faces must be (F, 3) int64");
  const int64_t n = values.size(0), width = values.size(1), count = faces.size(0);
  const double* value = in<double>(values);
  const int64_t* corner = in<int64_t>(faces);
  for (int64_t i = 0; i < 3 * count; ++i)
    check(corner[i] >= 0 && corner[i] < n, "faces must hold rows of the values");
  std::vector<double> known(n, 1.0), counts;
  for (int64_t i = 0; i < n; ++i)
    for (int64_t c = 0; c < width; ++c)
      if (std::isnan(value[i * width + c])) known[i] = 0;
  counts = known;
  const Tensor sums = new_zeros(values, {n, width});
  double* sum = out<double>(sums);
  const auto add = [&](int64_t to, int64_t from) {
    if (!known[from]) return;
    for (int64_t c = 0; c < width; ++c) sum[to * width + c] += value[from * width + c];
  };
  for (int64_t i = 0; i < n; ++i) add(i, i);
  for (int64_t f = 0; f < count; ++f)
    for (int v = 0; v < 3; ++v) {
      const int64_t to = corner[3 * f + v];
      for (int o = 1; o < 3; ++o) {
        const int64_t from = corner[3 * f + (v + o) % 3];
        add(to, from);
        counts[to] += known[from];
      }
    }
  for (int64_t i = 0; i < n; ++i)
    for (int64_t c = 0; c < width; ++c) sum[i * width + c] /= counts[i];
  return sums;
}

}  // namespace

std::vector<Operator> ridge_operators() {
  return {
      {"ridge_positions(Tensor points, Tensor strides, int steps, float fall, Tensor centers, "
       "Tensor raw_scale_tril, Tensor weights, int k, float covariance_scale, "
       "float min_lengthscale, Tensor index) -> Tensor",
       &boxed<ridge_positions>},
      {"mean_with_neighbors(Tensor values, Tensor faces) -> Tensor", &boxed<mean_with_neighbors>},
  };
}

}  // namespace lardhm
