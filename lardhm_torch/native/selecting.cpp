// Selects points of a scan: those without a cluster, and those that may lie in one.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "clusters.h"

namespace lardhm {
namespace {

// The points that are kept, in order.
template <class T, int D, class Stays>
Tensor points_that(const Tensor& points, const Stays& stays) {
  constexpr int64_t kGrain = 8192;
  const int64_t n = points.size(0), tasks = (n + kGrain - 1) / kGrain;
  std::vector<int64_t> first(tasks + 1, 0);
  std::vector<int32_t> kept(n);  // rows relative to the begin of each task
  run_tasks(tasks, [&](int64_t task) {
    const int64_t begin = task * kGrain, size = std::min(n - begin, kGrain);
    int64_t staying = 0;
    for (int64_t i = 0; i < size; ++i) {
      kept[begin + staying] = int32_t(i);
      staying += stays(begin + i);
    }
    first[task + 1] = staying;
  });
  for (int64_t task = 0; task < tasks; ++task) first[task + 1] += first[task];
  const Tensor staying = torch::stable::new_empty(points, {first[tasks], D});
  run_tasks(tasks, [&](int64_t task) {
    const T* from = in<T>(points) + task * kGrain * D;
    for (int64_t i = 0; i < first[task + 1] - first[task]; ++i)
      std::copy_n(from + kept[task * kGrain + i] * D, D, out<T>(staying) + (first[task] + i) * D);
  });
  return staying;
}

Tensor unexplained(const Tensor& given_points, const Tensor& given_owners,
                   const Tensor& given_kept) {
  const Tensor points = tidy(given_points), owners = tidy(given_owners), kept = tidy(given_kept);
  check(points.dim() == 2 && owners.numel() == points.size(0) &&
            owners.scalar_type() == ScalarType::Int && kept.scalar_type() == ScalarType::Bool,
        "owners must be (N,) int32, one a point, and kept (M,) bool");
  const int32_t* owner = in<int32_t>(owners);
  const bool* keeps = in<bool>(kept);
  const uint64_t count = uint64_t(kept.numel());
  return dispatch(points, [&](auto type, auto dim) {
    return points_that<decltype(type), dim()>(points, [=](int64_t row) {
      return uint32_t(owner[row]) >= count || !keeps[owner[row]];
    });
  });
}

// Cells of a grid over the boxes around ellipsoids; those that a box touches are marked.
template <class T, int D>
struct Marks {
  static constexpr int kCells = D == 3 ? 32 : 256;  // along an axis
  T low[D], high[D], scale[D];
  std::vector<char> cells;

  // Boxes of (count, D) middles with half their edges.
  Marks(const T* middle, const T* half, int64_t count) {
    for (int d = 0; d < D; ++d) {
      low[d] = std::numeric_limits<T>::infinity();
      high[d] = -low[d];
      for (int64_t m = 0; m < count; ++m) {
        low[d] = std::min(low[d], middle[m * D + d] - half[m * D + d]);
        high[d] = std::max(high[d], middle[m * D + d] + half[m * D + d]);
      }
      scale[d] = kCells / std::max(high[d] - low[d], std::numeric_limits<T>::min());
    }
    int64_t size = 1;
    for (int d = 0; d < D; ++d) size *= kCells;
    cells.assign(size, 0);
    for (int64_t m = 0; m < count; ++m) mark(middle + m * D, half + m * D);
  }

  int cell(T x, int d) const {
    const T at = (x - low[d]) * scale[d];
    return at > 0 ? std::min(int(std::min(at, T(kCells))), kCells - 1) : 0;
  }

  void mark(const T* middle, const T* half) {
    int first[D], last[D], at[D];
    for (int d = 0; d < D; ++d) {
      first[d] = at[d] = cell(middle[d] - half[d], d);
      last[d] = cell(middle[d] + half[d], d);
    }
    for (int d = 0; d >= 0;) {  // all runs of cells along the last axis
      std::fill_n(cells.data() + index(at), last[D - 1] - first[D - 1] + 1, char(1));
      for (d = D - 2; d >= 0 && ++at[d] > last[d]; --d) at[d] = first[d];
    }
  }

  static int64_t index(const int* at) {
    int64_t i = 0;
    for (int d = 0; d < D; ++d) i = i * kCells + at[d];
    return i;
  }

  bool marked(const T* point) const {
    int at[D];
    bool inside = true;
    for (int d = 0; d < D; ++d) {
      inside &= point[d] >= low[d] && point[d] <= high[d];
      at[d] = cell(point[d], d);
    }
    return inside && cells[index(at)];
  }
};

// (M, D) how far ellipsoids of clusters, `radius` standard deviations, extend along the axes.
template <class T, int D>
std::vector<T> extents(const Tensor& counts, const Tensor& scatters, double floor, double radius) {
  const int64_t count = counts.numel();
  std::vector<T> half(count * D);
  for (int64_t m = 0; m < count; ++m) {
    Matrix<D> lower;
    factor<D>(in<T>(scatters) + m * D * D, double(in<int64_t>(counts)[m]), floor, lower);
    for (int i = 0; i < D; ++i) {
      double variance = 0;
      for (int j = 0; j <= i; ++j) variance += lower[i][j] * lower[i][j];
      half[m * D + i] = T(radius * std::sqrt(variance));
    }
  }
  return half;
}

Tensor possibly_inside(const Tensor& given_points, const Tensor& given_counts,
                       const Tensor& given_means, const Tensor& given_scatters, double floor,
                       double radius) {
  const Tensor points = tidy(given_points), counts = tidy(given_counts);
  const Tensor means = tidy(given_means), scatters = tidy(given_scatters);
  check_rows("points", points, means);
  check_moments(counts, means, scatters, means);
  return dispatch(means, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const int64_t count = means.size(0);
    const auto half = extents<T, D>(counts, scatters, floor, 1.0001 * radius);
    const Marks<T, D> marks(in<T>(means), half.data(), count);
    const T* from = in<T>(points);
    return points_that<T, D>(points, [&](int64_t row) { return marks.marked(from + row * D); });
  });
}

}  // namespace
}  // namespace lardhm

STABLE_TORCH_LIBRARY_FRAGMENT(lardhm, m) {
  m.def("unexplained(Tensor points, Tensor owners, Tensor kept) -> Tensor");
  m.def(
      "possibly_inside(Tensor points, Tensor counts, Tensor means, Tensor scatters, float floor, "
      "float radius) -> Tensor");
}

STABLE_TORCH_LIBRARY_IMPL(lardhm, CPU, m) {
  m.impl("unexplained", TORCH_BOX(&lardhm::unexplained));
  m.impl("possibly_inside", TORCH_BOX(&lardhm::possibly_inside));
}
