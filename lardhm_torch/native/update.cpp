// Updates with scans: the cluster that a point belongs to, the clusters that points are close to, and
// those that a scan can change.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "clusters.h"
#include "kernel.h"
#include "sorting.h"

namespace lardhm {
namespace {

// k = 1: the nearest center of every point, if it is near enough in standard deviations.
template <class T, int D>
struct OwnerVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  const int32_t* order;
  const T *positions, *shapes;
  T limit;  // squared standard deviations
  int32_t* owners;

  OwnerVisitor(const Parameters<T, D>& parameters, double radius, int32_t* owners_)
      : order(parameters.index.order), positions(parameters.positions.data),
        shapes(parameters.shapes.data), limit(T(radius * radius)), owners(owners_) {}

  void invalid(int64_t row) override { owners[row] = -1; }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    for (int64_t j = 0; j < selected.size; ++j) {
      const int64_t rank = selected.rank[j];
      V z[D];
      whiten<T, D>(packet, positions + rank * Layout<D>::position,
                   shapes + rank * Layout<D>::shape, z);
      V squared = z[0] * z[0];
      for (int d = 1; d < D; ++d) squared += z[d] * z[d];
      T distance[Simd<T>::W];
      std::memcpy(distance, &squared, sizeof(squared));
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        owners[packet.row(lane)] = distance[lane] <= limit ? order[rank] : -1;
      }
    }
  }
};

// Raw factors of clusters from their moments.
template <class T, int D>
void write_raw_factors(const Tensor& counts, const Tensor& scatters, double floor, T* raw) {
  constexpr int64_t kGrain = 512;
  const int64_t size = counts.numel();
  std::atomic<bool> definite{true};
  run_tasks((size + kGrain - 1) / kGrain, [&](int64_t task) {
    for (int64_t m = task * kGrain; m < std::min(size, (task + 1) * kGrain); ++m) {
      Matrix<D> lower;
      if (!factor<D>(in<T>(scatters) + m * D * D, double(in<int64_t>(counts)[m]), floor, lower))
        definite = false;
      for (int i = 0; i < D; ++i)
        for (int j = 0; j < D; ++j)
          raw[(m * D + i) * D + j] = T(i == j ? std::log(lower[i][i]) : i > j ? lower[i][j] : 0);
    }
  });
  check(definite, "a covariance is not positive definite");
}

Tensor nearest_clusters(const Tensor& given_points, const Tensor& given_counts,
                        const Tensor& given_means, const Tensor& given_scatters, double floor,
                        double radius) {
  const Tensor points = tidy(given_points), counts = tidy(given_counts);
  const Tensor means = tidy(given_means), scatters = tidy(given_scatters);
  check_rows("points", points, means);
  check_moments(counts, means, scatters, means);
  const int64_t count = means.size(0), n = points.size(0);
  check(count > 0, "there must be at least one cluster");
  const Tensor weights = new_zeros(means, {count});
  const Tensor no_index = new_empty(means, {0}, ScalarType::Byte);
  const Tensor raw = new_empty(scatters, scatters.sizes());
  const Tensor owners = new_empty(points, {n}, ScalarType::Int);
  dispatch(means, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    write_raw_factors<T, D>(counts, scatters, floor, out<T>(raw));
    const MapTensors map(means, raw, weights, no_index, 1.0, 0.0);
    with_parameters<T, D>(map, n, [&](Parameters<T, D>& parameters) {
      std::vector<OwnerVisitor<T, D>> visitors;
      for (int64_t part = 0; part < parts_of(n, 1, parameters); ++part)
        visitors.emplace_back(parameters, radius, out<int32_t>(owners));
      if (n) visit_parts<T, D>(in<T>(points), n, parameters, 1, each_of<T, D>(visitors));
    });
    return 0;
  });
  return owners;
}

// Sums over points of the kernel values of each wanted cluster, those of one thread.
template <class T, int D>
struct SumVisitor final : Visitor<T, D> {
  const int32_t* order;
  const T *positions, *shapes;
  const bool* wanted;        // by row
  std::vector<double> sums;  // by rank

  SumVisitor(const Parameters<T, D>& parameters, const bool* wanted_, int64_t count)
      : order(parameters.index.order), positions(parameters.positions.data),
        shapes(parameters.shapes.data), wanted(wanted_), sums(count) {}

  void invalid(int64_t) override {}

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    for (int64_t j = 0; j < selected.size; ++j) {
      const int64_t rank = selected.rank[j];
      if (!wanted[order[rank]]) continue;
      const auto value = feature_of<T, D>(packet, positions + rank * Layout<D>::position,
                                          shapes + rank * Layout<D>::shape);
      T lanes[Simd<T>::W];
      std::memcpy(lanes, &value, sizeof(value));
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1)
        sums[rank] += double(lanes[__builtin_ctz(bits)]);
    }
  }
};

Tensor feature_sums(const Tensor& given_points, const Tensor& centers, const Tensor& raw,
                    const Tensor& index, const Tensor& given_wanted, int64_t k,
                    double covariance_scale, double min_lengthscale) {
  check_k(k);
  const Tensor points = tidy(given_points), wanted = tidy(given_wanted);
  check_rows("points", points, centers);
  const int64_t n = points.size(0), count = centers.size(0);
  check(wanted.scalar_type() == ScalarType::Bool && wanted.numel() == count,
        "wanted must be (M,) bool, one per center");
  const Tensor weights = new_zeros(centers, {count});
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  const Tensor sums = new_zeros(map.centers, {count});
  k = std::min(k, count);
  if (n == 0 || k == 0) return sums;
  dispatch(map.centers, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    with_parameters<T, D>(map, n, [&](Parameters<T, D>& parameters) {
      std::vector<SumVisitor<T, D>> visitors;
      for (int64_t part = 0; part < parts_of(n, 8 * count, parameters); ++part)
        visitors.emplace_back(parameters, in<bool>(wanted), count);
      visit_parts<T, D>(in<T>(points), n, parameters, k, each_of<T, D>(visitors));
      for (int64_t rank = 0; rank < count; ++rank) {
        double sum = 0;
        for (const auto& visitor : visitors) sum += visitor.sums[rank];
        out<T>(sums)[parameters.index.order[rank]] = T(sum);
      }
    });
    return 0;
  });
  return sums;
}

// Marks the neighbors of all points.
template <class T, int D>
struct MarkVisitor final : Visitor<T, D> {
  const int32_t* order;
  int64_t k;
  bool* marked;  // by row; threads only ever write true

  MarkVisitor(const Parameters<T, D>& parameters, int64_t k_, bool* marked_)
      : order(parameters.index.order), k(k_), marked(marked_) {}

  void mark(int64_t row) { __atomic_store_n(marked + row, true, __ATOMIC_RELAXED); }

  void invalid(int64_t) override {
    for (int64_t row = 0; row < k; ++row) mark(row);  // as `features.nearest_centers`
  }

  void packet(const Packet<T, D>&, const Selection& selected) override {
    for (int64_t j = 0; j < selected.size; ++j) mark(order[selected.rank[j]]);
  }
};

Tensor neighbors_of(const Tensor& given_points, const Tensor& given_centers, int64_t k,
                    const Tensor& given_index) {
  check_k(k);
  const Tensor points = tidy(given_points), centers = tidy(given_centers);
  const Tensor index = usable_index(given_index);
  check_rows("points", points, centers);
  const int64_t n = points.size(0), count = centers.size(0);
  const Tensor marked = new_empty(centers, {count}, ScalarType::Bool);
  std::fill_n(out<bool>(marked), count, false);
  k = std::min(k, count);
  if (n == 0 || k == 0) return marked;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const CallIndex<T, D> call(in<char>(index), index.numel(), in<T>(centers), count);
    Parameters<T, D> parameters(call.index, in<T>(centers), nullptr, nullptr, {},
                                n >= count / kPointsOfFew);
    MarkVisitor<T, D> visitor(parameters, k, out<bool>(marked));
    visit_all<T, D>(in<T>(points), n, parameters, k, visitor);
    return 0;
  });
  return marked;
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

  // The norm of a row of the factor; most rows are rejected without an exponential.
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
  const Tensor weights = new_empty(centers, {count});
  const Tensor no_index = new_empty(centers, {0}, ScalarType::Byte);
  const MapTensors map(centers, raw, weights, no_index, covariance_scale, min_lengthscale);
  const Tensor found = new_empty(map.centers, {count}, ScalarType::Bool);
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

std::vector<Operator> update_operators() {
  return {
      {"nearest_clusters(Tensor points, Tensor counts, Tensor means, Tensor scatters, float floor, "
       "float radius) -> Tensor",
       &boxed<nearest_clusters>},
      {"feature_sums(Tensor points, Tensor centers, Tensor raw_scale_tril, Tensor index, "
       "Tensor wanted, int k, float covariance_scale, float min_lengthscale) -> Tensor",
       &boxed<feature_sums>},
      {"neighbors_of(Tensor points, Tensor centers, int k, Tensor index) -> Tensor",
       &boxed<neighbors_of>},
      {"reaching(Tensor centers, Tensor raw_scale_tril, Tensor points, float stds, "
       "float covariance_scale, float min_lengthscale) -> Tensor",
       &boxed<reaching>},
  };
}

}  // namespace lardhm
