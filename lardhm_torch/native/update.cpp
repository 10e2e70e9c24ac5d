// Scans into maps: points to the clusters that explain them, and which clusters a scan can touch.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <tuple>
#include <vector>

#include "kernel.h"
#include "sorting.h"
#include "tensors.h"

namespace lardhm {
namespace {

// k = 1: the nearest center of every point, how far it is in standard deviations, and the moments of
// the points that are near enough.
template <class T, int D>
struct ExplainVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  static constexpr int kMoments = 1 + D + D * (D + 1) / 2;
  const int32_t* order;
  const T *positions, *shapes;
  T joins, explains;  // squared standard deviations
  int32_t none;
  int32_t* owners;
  double* sums;  // (M, kMoments) by rank: count, offsets, lower triangle of their products

  ExplainVisitor(const Parameters<T, D>& parameters, double radius, double reach, int32_t* owners_,
                 double* sums_)
      : order(parameters.index.order), positions(parameters.positions.data),
        shapes(parameters.shapes.data), joins(T(radius * radius)), explains(T(reach * reach)),
        none(int32_t(parameters.index.header.count)), owners(owners_), sums(sums_) {}

  void invalid(int64_t row) override { owners[row] = none; }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    T at[D][Simd<T>::W];
    std::memcpy(at, packet.x, sizeof(at));
    for (int64_t j = 0; j < selected.size; ++j) {
      const int64_t rank = selected.rank[j];
      const T* center = positions + rank * Layout<D>::position;
      V z[D];
      whiten<T, D>(packet, center, shapes + rank * Layout<D>::shape, z);
      V squared = z[0] * z[0];
      for (int d = 1; d < D; ++d) squared += z[d] * z[d];
      T distance[Simd<T>::W];
      std::memcpy(distance, &squared, sizeof(squared));
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        owners[packet.row(lane)] = distance[lane] <= explains ? order[rank] : none;
        if (!(distance[lane] <= joins)) continue;
        T offset[D];
        for (int d = 0; d < D; ++d) offset[d] = at[d][lane] - center[d];
        add(offset, sums + rank * kMoments);
      }
    }
  }

  static void add(const T* offset, double* to) {
    to[0] += 1;
    for (int d = 0; d < D; ++d) to[1 + d] += offset[d];
    double* product = to + 1 + D;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j) *product++ += double(offset[i]) * double(offset[j]);
  }
};

// Sums of the parts of a rank as rows of the tensors: count, offsets, symmetric scatter.
template <class T, int D>
void write_moments(const std::vector<double>& sums, int64_t parts, const int32_t* order,
                   int64_t count, T* counts, T* offsets, T* scatters) {
  constexpr int kMoments = ExplainVisitor<T, D>::kMoments;
  for (int64_t rank = 0; rank < count; ++rank) {
    double sum[kMoments] = {};
    for (int64_t part = 0; part < parts; ++part)
      for (int i = 0; i < kMoments; ++i) sum[i] += sums[(part * count + rank) * kMoments + i];
    const int64_t row = order[rank];
    counts[row] = T(sum[0]);
    for (int d = 0; d < D; ++d) offsets[row * D + d] = T(sum[1 + d]);
    const double* product = sum + 1 + D;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j, ++product)
        scatters[(row * D + i) * D + j] = scatters[(row * D + j) * D + i] = T(*product);
  }
}

using Explained = std::tuple<Tensor, Tensor, Tensor, Tensor>;

Explained explain(const Tensor& given_points, const Tensor& centers, const Tensor& raw,
                  double radius, double reach) {
  const Tensor points = tidy(given_points);
  check_rows("points", points, centers);
  const int64_t count = centers.size(0), dim_size = centers.size(1), n = points.size(0);
  STD_TORCH_CHECK(count > 0, "centers must hold at least one row");
  const Tensor weights = torch::stable::new_zeros(centers, {count});
  const Tensor no_index = torch::stable::new_empty(centers, {0}, ScalarType::Byte);
  const MapTensors map(centers, raw, weights, no_index, 1.0, 0.0);
  const Explained result{torch::stable::new_empty(points, {n}, ScalarType::Int),
                         torch::stable::new_zeros(points, {count}),
                         torch::stable::new_zeros(points, {count, dim_size}),
                         torch::stable::new_zeros(points, {count, dim_size, dim_size})};
  if (n == 0) return result;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    with_parameters<T, D>(map, n, [&](Parameters<T, D>& parameters) {
      const int64_t size = count * ExplainVisitor<T, D>::kMoments;
      const int64_t parts = parts_of(n, size * sizeof(double), parameters);
      std::vector<double> sums(size * parts);
      visit_parts<T, D>(in<T>(points), n, parameters, 1, parts, [&](int64_t part) {
        return std::make_unique<ExplainVisitor<T, D>>(parameters, radius, reach,
                                                      out<int32_t>(std::get<0>(result)),
                                                      sums.data() + part * size);
      });
      write_moments<T, D>(sums, parts, parameters.index.order, count, out<T>(std::get<1>(result)),
                          out<T>(std::get<2>(result)), out<T>(std::get<3>(result)));
    });
    return 0;
  });
  return result;
}

// Neighbors of each point, ascending by row of the centers, and their kernel values, written to the
// place of the point in another order.
template <class T, int D>
struct PlacedVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  const int32_t* order;
  const T *positions, *shapes;
  const int32_t* place;
  int64_t k;
  int32_t* rows;
  T* values;
  std::vector<uint64_t> sorted;  // row of the centers, and which of the selected it is

  PlacedVisitor(const Parameters<T, D>& parameters, const int32_t* place_, int64_t k_,
                int32_t* rows_, T* values_)
      : order(parameters.index.order), positions(parameters.positions.data),
        shapes(parameters.shapes.data), place(place_), k(k_), rows(rows_), values(values_) {}

  void invalid(int64_t row) override {
    for (int64_t j = 0; j < k; ++j) {
      rows[place[row] * k + j] = int32_t(j);
      values[place[row] * k + j] = std::numeric_limits<T>::quiet_NaN();
    }
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    sorted.resize(selected.size);
    for (int64_t j = 0; j < selected.size; ++j)
      sorted[j] = uint64_t(order[selected.rank[j]]) << 32 | uint64_t(j);
    std::sort(sorted.begin(), sorted.end());
    int64_t next[Simd<T>::W];
    for (int lane = 0; lane < packet.lanes; ++lane) next[lane] = int64_t(place[packet.row(lane)]) * k;
    for (uint64_t item : sorted) {
      const int64_t j = int64_t(uint32_t(item)), rank = selected.rank[j];
      V z[D];
      whiten<T, D>(packet, positions + rank * Layout<D>::position,
                   shapes + rank * Layout<D>::shape, z);
      const V kernel = kernel_of<T, D>(z);
      T value[Simd<T>::W];
      std::memcpy(value, &kernel, sizeof(kernel));
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        rows[next[lane]] = int32_t(item >> 32);
        values[next[lane]++] = value[lane];
      }
    }
  }
};

// Where each row comes to stand in an order of n rows.
std::vector<int32_t> places_of(const Tensor& order, int64_t n) {
  STD_TORCH_CHECK(order.scalar_type() == ScalarType::Long && order.numel() == n &&
                      n < (int64_t(1) << 31),
                  "order must be int64 and hold every row of the points once");
  std::vector<int32_t> place(n, -1);
  const int64_t* row = in<int64_t>(order);
  for (int64_t i = 0; i < n; ++i) {
    STD_TORCH_CHECK(row[i] >= 0 && row[i] < n && place[row[i]] < 0,
                    "order must hold every row of the points once");
    place[row[i]] = int32_t(i);
  }
  return place;
}

std::tuple<Tensor, Tensor> ordered_features(const Tensor& given_points, const Tensor& given_order,
                                            const Tensor& centers, const Tensor& raw,
                                            const Tensor& index, int64_t k,
                                            double covariance_scale, double min_lengthscale) {
  check_k(k);
  const Tensor points = tidy(given_points), order = tidy(given_order);
  check_rows("points", points, centers);
  const Tensor weights = torch::stable::new_zeros(centers, {centers.size(0)});
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  k = std::min(k, centers.size(0));
  const int64_t n = points.size(0);
  const Tensor rows = torch::stable::new_empty(points, {n, k}, ScalarType::Int);
  const Tensor values = torch::stable::new_empty(points, {n, k});
  if (k == 0) return {rows, values};
  const std::vector<int32_t> place = places_of(order, n);
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_parameters<T, dim()>(map, n, [&](Parameters<T, dim()>& parameters) {
      visit_all<T, dim()>(in<T>(points), n, parameters, k, [&](int64_t) {
        return std::make_unique<PlacedVisitor<T, dim()>>(parameters, place.data(), k,
                                                         out<int32_t>(rows), out<T>(values));
      });
    });
    return 0;
  });
  return {rows, values};
}

// Whether a kernel's extent along every axis, `stds` standard deviations, meets the box.
template <class T, int D>
struct Extents {
  const T *centers, *raw, *lower, *upper;
  T stds, floor;  // of a kernel; of a raw factor's diagonal

  bool meets(int64_t row) const {
    for (int d = 0; d < D; ++d) {
      const T at = centers[row * D + d];
      const T gap = std::max(lower[d] - at, at - upper[d]);
      if (gap > 0 && !extends(raw + (row * D + d) * D, d, gap)) return false;
      if (gap != gap) return false;
    }
    return true;
  }

  // The norm of a row of the factor, most of which need no exponential to be found too short.
  bool extends(const T* factor, int d, T gap) const {
    T below = 0;
    for (int j = 0; j < d; ++j) below += factor[j] * factor[j];
    const T wanted = (gap / stds) * (gap / stds);
    if (factor[d] < 0 && floor <= 1 && below + 1 < wanted) return false;
    const T length = std::max(std::exp(factor[d]), floor);
    return below + length * length >= wanted;
  }
};

Tensor reaching(const Tensor& centers, const Tensor& raw, const Tensor& given_points, double stds,
                double covariance_scale, double min_lengthscale) {
  const Tensor points = tidy(given_points);
  check_rows("points", points, centers);
  const int64_t count = centers.size(0);
  const Tensor weights = torch::stable::new_empty(centers, {count});
  const Tensor no_index = torch::stable::new_empty(centers, {0}, ScalarType::Byte);
  const MapTensors map(centers, raw, weights, no_index, covariance_scale, min_lengthscale);
  const Tensor found = torch::stable::new_empty(map.centers, {count}, ScalarType::Bool);
  bool* to = out<bool>(found);
  dispatch(map.centers, [&](auto type, auto dim) {
    using T = decltype(type);
    Box<T, dim()> box;
    box.add(in<T>(points), 0, points.size(0), 1);
    const Extents<T, dim()> extents{in<T>(map.centers), in<T>(map.raw), box.low, box.high,
                                    T(stds * std::sqrt(covariance_scale)), T(min_lengthscale)};
    constexpr int64_t kGrain = 8192;
    run_tasks((count + kGrain - 1) / kGrain, [&](int64_t task) {
      const int64_t end = std::min(count, (task + 1) * kGrain);
      for (int64_t row = task * kGrain; row < end; ++row) to[row] = extents.meets(row);
    });
    return 0;
  });
  return found;
}

}  // namespace
}  // namespace lardhm

STABLE_TORCH_LIBRARY_FRAGMENT(lardhm, m) {
  m.def(
      "explain(Tensor points, Tensor centers, Tensor raw_scale_tril, float radius, float reach) "
      "-> (Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "ordered_features(Tensor points, Tensor order, Tensor centers, Tensor raw_scale_tril, "
      "Tensor index, int k, float covariance_scale, float min_lengthscale) -> (Tensor, Tensor)");
  m.def(
      "reaching(Tensor centers, Tensor raw_scale_tril, Tensor points, float stds, "
      "float covariance_scale, float min_lengthscale) -> Tensor");
}

STABLE_TORCH_LIBRARY_IMPL(lardhm, CPU, m) {
  m.impl("explain", TORCH_BOX(&lardhm::explain));
  m.impl("ordered_features", TORCH_BOX(&lardhm::ordered_features));
  m.impl("reaching", TORCH_BOX(&lardhm::reaching));
}
