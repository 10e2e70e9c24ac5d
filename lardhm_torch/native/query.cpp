// Queries: the index, the k nearest centers, their kernel values, log-odds and probability.

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "candidates.h"
#include "occupancy.h"
#include "tensors.h"

namespace lardhm {
namespace {

constexpr int64_t kMostInCube = 1024;  // points, as many as a region of the search holds

// Neighbors of each point, ascending by row of the centers, and optionally their kernel values. If
// another order of the points is given, they are written in that order and are not sorted: sums over
// all neighbors do not need it.
template <class T, int D, class Integer>
struct NeighborVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  const int32_t* order;
  const T *positions, *shapes;
  int64_t k;
  Integer* rows;
  T* values;  // may be null
  const int32_t* places;  // may be null

  NeighborVisitor(const Parameters<T, D>& parameters, int64_t k_, Integer* rows_, T* values_,
                  const int32_t* places_)
      : order(parameters.index.order), positions(parameters.positions.data),
        shapes(parameters.shapes.data), k(k_), rows(rows_), values(values_), places(places_) {}

  int64_t first_of(int64_t row) const { return (places ? int64_t(places[row]) : row) * k; }

  void invalid(int64_t row) override {
    const int64_t first = first_of(row);
    for (int64_t j = 0; j < k; ++j) {
      rows[first + j] = Integer(j);
      if (values) values[first + j] = std::numeric_limits<T>::quiet_NaN();
    }
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    int64_t next[Simd<T>::W];
    for (int lane = 0; lane < packet.lanes; ++lane) {  // prefetched before they are written
      next[lane] = first_of(packet.row(lane));
      __builtin_prefetch(rows + next[lane], 1);
      if (values) __builtin_prefetch(values + next[lane], 1);
    }
    std::vector<uint64_t> centers(selected.size);  // row of a center; where it stands in the selection
    for (int64_t j = 0; j < selected.size; ++j)
      centers[j] = uint64_t(order[selected.rank[j]]) << 32 | uint64_t(j);
    if (!places) std::sort(centers.begin(), centers.end());
    for (int64_t begin = 0; begin < selected.size; begin += kTogether)
      add(packet, selected, centers.data() + begin,
          int(std::min<int64_t>(kTogether, selected.size - begin)), next);
  }

  static constexpr int kTogether = 64;

  // The selected of n <= 64 centers and their kernels, lane by lane. A lane nearly always selects k of
  // them, so that loops over them are predictable.
  void add(const Packet<T, D>& packet, const Selection& selected, const uint64_t* centers, int n,
           int64_t* next) const {
    constexpr int W = Simd<T>::W, kRoom = kTogether + kWide;
    alignas(64) V kernel[kTogether];  // by center, then each W of them by lane
    int32_t row[kRoom], found[W][kRoom];
    T found_kernel[W][kRoom];
    uint32_t bits[kRoom] = {};
    for (int j = 0; j < n; ++j) {
      const int64_t at = uint32_t(centers[j]), rank = selected.rank[at];
      bits[j] = selected.bits[at];
      row[j] = int32_t(centers[j] >> 32);
      if (values)
        kernel[j] = feature_of<T, D>(packet, positions + rank * Layout<D>::position,
                                     shapes + rank * Layout<D>::shape);
    }
    for (int j = 0; values && j < n; j += W) transpose<T>(kernel + j);
    const T* by_lane = reinterpret_cast<const T*>(kernel);
    uint64_t own[W];
    for (int lane = 0; lane < packet.lanes; ++lane) {
      own[lane] = members(bits, n, lane);
      gather<kWide>(own[lane], n, row, found[lane]);
      if (values) gather<W, W>(own[lane], n, by_lane + lane * W, found_kernel[lane]);
    }
    for (int lane = 0; lane < packet.lanes; ++lane) {
      const int count = __builtin_popcountll(own[lane]);
      copy(found[lane], count, rows + next[lane]);
      if (values) copy(found_kernel[lane], count, values + next[lane]);
      next[lane] += count;
    }
  }

  // Which of the n centers the lane selected.
  static uint64_t members(const uint32_t* bits, int n, int lane) {
    uint64_t found = 0;
    for (int i = 0; i < n; i += kWide) {
      const WideInt own = load<WideInt>(bits + i) & int32_t(1 << lane);
      found |= uint64_t(~bits_le<WideInt>(own, WideInt{}) & existing(0, kWide)) << i;
    }
    return found;
  }

  // Those of n numbers, Width after each other and then Stride farther on, whose bits are set.
  template <int Width, int Stride = 1, class X>
  static void gather(uint64_t bits, int n, const X* from, X* to) {
    for (int i = 0; i < n; i += Width) {
      const uint32_t some = uint32_t(bits >> i) & existing(0, Width);
      const X* block = from + i * Stride;
      if constexpr (sizeof(X) == 4)
        compress(some, block, to);
      else
        for (uint32_t left = some, j = 0; left; left &= left - 1) to[j++] = block[__builtin_ctz(left)];
      to += __builtin_popcount(some);
    }
  }

  // Eight at a time: their number is fixed.
  template <class From, class To>
  static void copy(const From* from, int n, To* to) {
    for (; n >= 8; n -= 8, from += 8, to += 8)
      for (int i = 0; i < 8; ++i) to[i] = To(from[i]);
    for (int i = 0; i < n; ++i) to[i] = To(from[i]);
  }
};

Tensor make_index(const Tensor& given_centers, int64_t k) {
  check_k(k);
  const Tensor centers = tidy(given_centers);
  Tensor index;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    const int64_t count = centers.size(0);
    index = new_empty(centers, {index_size<T, dim()>(count)}, ScalarType::Byte);
    write_index<T, dim()>(in<T>(centers), count, out<char>(index));
    return 0;
  });
  return index;
}

bool index_matches(const Tensor& index, const Tensor& given_centers, int64_t k) {
  check_k(k);
  if (index.scalar_type() != ScalarType::Byte || !index.is_contiguous()) return false;
  const Tensor centers = tidy(given_centers);
  return dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    return matches<T, dim()>(in<char>(index), index.numel(), in<T>(centers), centers.size(0));
  });
}

Tensor nearest(const Tensor& given_points, const Tensor& given_centers, int64_t k,
               const Tensor& given_index) {
  check_k(k);
  const Tensor points = tidy(given_points), centers = tidy(given_centers);
  const Tensor index = usable_index(given_index);
  check_rows("points", points, centers);
  k = std::min(k, centers.size(0));
  const int64_t n = points.size(0);
  const Tensor rows = new_empty(points, {n, k}, ScalarType::Long);
  if (k == 0) return rows;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    const CallIndex<T, dim()> call(in<char>(index), index.numel(), in<T>(centers),
                                   centers.size(0));
    Parameters<T, dim()> parameters(call.index, in<T>(centers), nullptr, nullptr, {},
                                    n >= centers.size(0) / kPointsOfFew);
    NeighborVisitor<T, dim(), int64_t> visitor(parameters, k, out<int64_t>(rows), nullptr, nullptr);
    visit_all<T, dim()>(in<T>(points), n, parameters, k, visitor);
    return 0;
  });
  return rows;
}

// Position of each row in an order of n rows (the inverse permutation).
std::vector<int32_t> places_of(const Tensor& order, int64_t n) {
  check(order.scalar_type() == ScalarType::Long && order.numel() == n &&
            n < (int64_t(1) << 31),
        "order must be int64 and hold every row of the points once");
  std::vector<int32_t> place(n, -1);
  const int64_t* row = in<int64_t>(order);
  for (int64_t i = 0; i < n; ++i) {
    check(row[i] >= 0 && row[i] < n && place[row[i]] < 0,
          "order must hold every row of the points once");
    place[row[i]] = int32_t(i);
  }
  return place;
}

// Asks for large pages where `count` elements will be written in no order: fewer faults, and fewer misses
// when addresses are translated. It is a hint; systems without it ignore it.
template <class T>
void prefer_large_pages([[maybe_unused]] T* array, [[maybe_unused]] int64_t count) {
#if defined(MADV_HUGEPAGE)
  constexpr uintptr_t kLarge = uintptr_t(1) << 21;
  const uintptr_t begin = reinterpret_cast<uintptr_t>(array);
  const uintptr_t end = reinterpret_cast<uintptr_t>(array + count);
  const uintptr_t first = (begin + kLarge - 1) / kLarge * kLarge, last = end / kLarge * kLarge;
  if (first < last) madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#endif
}

// Neighbors and kernel values of all points, row by row or, if `ordered`, those of the points in the
// order given, each point's own unsorted.
Tensors<2> features_in_order(const Tensor& given_points, const Tensor& given_order,
                             const Tensor& centers, const Tensor& raw, const Tensor& index,
                             int64_t k, const Scaling& scaling, bool ordered) {
  check_k(k);
  const Tensor points = tidy(given_points);
  check_rows("points", points, centers);
  const Tensor weights = new_zeros(centers, {centers.size(0)});
  const MapTensors map(centers, raw, weights, index, scaling.covariance_scale,
                       scaling.min_lengthscale);
  k = std::min(k, centers.size(0));
  const int64_t n = points.size(0);
  const Tensor rows = new_empty(points, {n, k}, ScalarType::Int);
  const Tensor values = new_empty(points, {n, k});
  if (k == 0) return {rows, values};
  std::vector<int32_t> places;
  if (ordered) places = places_of(tidy(given_order), n);
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    prefer_large_pages(out<int32_t>(rows), n * k);
    prefer_large_pages(out<T>(values), n * k);
    with_parameters<T, dim()>(map, n, [&](Parameters<T, dim()>& parameters) {
      NeighborVisitor<T, dim(), int32_t> visitor(parameters, k, out<int32_t>(rows), out<T>(values),
                                                 ordered ? places.data() : nullptr);
      visit_all<T, dim()>(in<T>(points), n, parameters, k, visitor);
    });
    return 0;
  });
  return {rows, values};
}

Tensors<2> nearest_features(const Tensor& points, const Tensor& centers, const Tensor& raw,
                            const Tensor& index, int64_t k, double covariance_scale,
                            double min_lengthscale) {
  const Scaling scaling{covariance_scale, min_lengthscale};
  return features_in_order(points, points, centers, raw, index, k, scaling, false);
}

Tensors<2> ordered_features(const Tensor& points, const Tensor& order, const Tensor& centers,
                            const Tensor& raw, const Tensor& index, int64_t k,
                            double covariance_scale, double min_lengthscale) {
  const Scaling scaling{covariance_scale, min_lengthscale};
  return features_in_order(points, order, centers, raw, index, k, scaling, true);
}

// Log-odds of an empty map: 0, and NaN where a coordinate is not finite.
template <class T>
void occupancy_of_nothing(const Tensor& points, bool probability, T* to) {
  const int64_t dim = points.size(1), n = points.size(0);
  const T* from = in<T>(points);
  for (int64_t row = 0; row < n; ++row) {
    T value = probability ? T(0.5) : T(0);
    for (int64_t d = 0; d < dim; ++d) value += from[row * dim + d] * T(0);
    to[row] = value;
  }
}

Tensor occupancy(const Tensor& given_points, const Tensor& centers, const Tensor& raw,
                 const Tensor& weights, int64_t k, double covariance_scale,
                 double min_lengthscale, const Tensor& index, bool probability) {
  check_k(k);
  const Tensor points = tidy(given_points);
  check_rows("points", points, centers);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  k = std::min(k, centers.size(0));
  const Tensor values = new_empty(points, {points.size(0)});
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    if (k == 0) {
      occupancy_of_nothing<T>(points, probability, out<T>(values));
      return 0;
    }
    const int64_t n = points.size(0);
    with_parameters<T, dim()>(map, n, [&](Parameters<T, dim()>& parameters) {
      OccupancyVisitor<T, dim()> visitor(parameters, probability, out<T>(values));
      visit_all<T, dim()>(in<T>(points), n, parameters, k, visitor);
    });
    return 0;
  });
  return values;
}

// The same for a lattice; `axes` holds the coordinates of all axes after each other.
Tensor lattice_occupancy(const Tensor& given_axes, const Sizes& shape,
                         const Tensor& centers, const Tensor& raw, const Tensor& weights, int64_t k,
                         double covariance_scale, double min_lengthscale, const Tensor& index,
                         bool probability) {
  check_k(k);
  const Tensor axes = tidy(given_axes);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  int64_t coordinates = 0, total = 1, near = 1;
  for (int64_t n : shape) coordinates += n, total *= n;
  for (size_t d = 1; d < shape.size(); ++d) near *= shape[d];
  check(int64_t(shape.size()) == centers.size(1) && axes.numel() == coordinates &&
            axes.scalar_type() == centers.scalar_type() && near < (int64_t(1) << 26),
        "axes must hold one list of coordinates for each dimension of the map, of its "
        "dtype, and fewer than 2^26 points in a plane");
  k = std::min(k, centers.size(0));
  const Tensor values = new_zeros(axes, shape);
  if (total == 0 || k == 0) return probability ? fill(values, 0.5) : values;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const T* axis[D];
    for (int d = 0; d < D; ++d) axis[d] = d ? axis[d - 1] + shape[d - 1] : in<T>(axes);
    with_parameters<T, D>(map, total, [&](Parameters<T, D>& parameters) {
      OccupancyVisitor<T, D> visitor(parameters, probability, out<T>(values));
      visit_lattice<T, D>(axis, shape.data(), parameters, k, visitor);
    });
    return 0;
  });
  return values;
}

// Log-odds at the points of cubes of a lattice, (B, edge, ...) for (B, D) first points.
Tensor cube_log_odds(const Tensor& given_axes, const Sizes& shape,
                     const Tensor& given_firsts, int64_t edge, const Tensor& centers,
                     const Tensor& raw, const Tensor& weights, int64_t k, double covariance_scale,
                     double min_lengthscale, const Tensor& index) {
  check_k(k);
  const Tensor axes = tidy(given_axes), firsts = tidy(given_firsts);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  const int64_t dim = centers.size(1), cubes = firsts.size(0);
  int64_t coordinates = 0, points = 1;
  for (int64_t n : shape) coordinates += n;
  for (int64_t d = 0; d < dim; ++d) points *= edge;
  check(int64_t(shape.size()) == dim && axes.numel() == coordinates &&
            axes.scalar_type() == centers.scalar_type(),
        "axes must hold one list of coordinates for each dimension of the map, of its dtype");
  check(edge >= 1 && edge <= 32 && points <= kMostInCube,
        "a cube must have 1 to 1024 points");
  check(firsts.dim() == 2 && firsts.size(1) == dim && firsts.scalar_type() == ScalarType::Long,
        "firsts must be (B, D) int64");
  for (int64_t i = 0; i < cubes * dim; ++i)
    check(in<int64_t>(firsts)[i] >= 0 && in<int64_t>(firsts)[i] + edge <= shape[i % dim],
          "cubes must lie in the lattice");
  std::vector<int64_t> sizes(1, cubes);
  sizes.insert(sizes.end(), dim, edge);
  k = std::min(k, centers.size(0));
  const Tensor values = new_zeros(
      axes, sizes);
  if (cubes == 0 || k == 0) return values;
  dispatch(centers, [&](auto type, auto dimension) {
    using T = decltype(type);
    constexpr int D = dimension();
    const T* axis[D];
    for (int d = 0; d < D; ++d) axis[d] = d ? axis[d - 1] + shape[d - 1] : in<T>(axes);
    with_parameters<T, D>(map, cubes * points, [&](Parameters<T, D>& parameters) {
      OccupancyVisitor<T, D> visitor(parameters, false, out<T>(values));
      visit_cubes<T, D>(axis, in<int64_t>(firsts), cubes, edge, parameters, k, visitor);
    });
    return 0;
  });
  return values;
}

}  // namespace

std::vector<Operator> query_operators() {
  return {
      {"build_index(Tensor centers, int k) -> Tensor", &boxed<make_index>},
      {"index_matches(Tensor index, Tensor centers, int k) -> bool", &boxed<index_matches>},
      {"nearest(Tensor points, Tensor centers, int k, Tensor index) -> Tensor", &boxed<nearest>},
      {"nearest_features(Tensor points, Tensor centers, Tensor raw_scale_tril, Tensor index, int k, "
       "float covariance_scale, float min_lengthscale) -> (Tensor, Tensor)",
       &boxed<nearest_features>},
      {"ordered_features(Tensor points, Tensor order, Tensor centers, Tensor raw_scale_tril, "
       "Tensor index, int k, float covariance_scale, float min_lengthscale) -> (Tensor, Tensor)",
       &boxed<ordered_features>},
      {"occupancy", &boxed<occupancy>},  // operators.py defines it
      {"lattice_occupancy(Tensor axes, int[] shape, Tensor centers, Tensor raw_scale_tril, "
       "Tensor weights, int k, float covariance_scale, float min_lengthscale, Tensor index, "
       "bool probability) -> Tensor",
       &boxed<lattice_occupancy>},
      {"cube_log_odds(Tensor axes, int[] shape, Tensor firsts, int edge, Tensor centers, "
       "Tensor raw_scale_tril, Tensor weights, int k, float covariance_scale, "
       "float min_lengthscale, Tensor index) -> Tensor",
       &boxed<cube_log_odds>},
  };
}

}  // namespace lardhm
