// k-means: assigns points to their nearest centers, sums their moments, and moves the centers.

#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "moments.h"
#include "sorting.h"
#include "tensors.h"

namespace lardhm {
namespace {

// k = 1: the own center of every point, and the moments of the offsets from it.
template <class T, int D>
struct AssignVisitor final : Visitor<T, D> {
  const int32_t* order;
  const T* positions;
  bool scatter;
  int64_t* labels;  // may be null
  double* sums;  // (M, kMoments<D>) by rank

  AssignVisitor(const Parameters<T, D>& parameters, bool scatter_, int64_t* labels_, double* sums_)
      : order(parameters.index.order), positions(parameters.positions.data), scatter(scatter_),
        labels(labels_), sums(sums_) {}

  void invalid(int64_t row) override {
    if (labels) labels[row] = -1;
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    for (int64_t j = 0; j < selected.size; ++j) {
      const int64_t rank = selected.rank[j];
      const T* center = positions + rank * Layout<D>::position;
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        if (labels) labels[packet.row(lane)] = order[rank];
        T offset[D];
        for (int d = 0; d < D; ++d) offset[d] = packet.x[d][lane] - center[d];
        add_moments<T, D>(offset, scatter, sums + rank * kMoments<D>);
      }
    }
  }
};

// Moments of n points by the rank of their nearest center, in as many parts as pay off.
template <class T, int D>
MomentParts<D> moments_of(const T* points, int64_t n, const T* centers, const Index& index,
                          bool scatter, int64_t* labels) {
  const int64_t count = index.header.count;
  Parameters<T, D> parameters(index, centers, nullptr, nullptr, {}, n >= count / kPointsOfFew);
  const int64_t bytes = count * kMoments<D> * sizeof(double);
  MomentParts<D> moments(count, parts_of(n, bytes, parameters));
  std::vector<AssignVisitor<T, D>> visitors;
  for (int64_t part = 0; part < moments.parts; ++part)
    visitors.emplace_back(parameters, scatter, labels, moments.part(part));
  visit_parts<T, D>(points, n, parameters, 1, each_of<T, D>(visitors));
  return moments;
}

using Moments = Tensors<4>;

Moments assign(const Tensor& given_points, const Tensor& given_centers, const Tensor& given_index,
               bool scatter) {
  const Tensor points = tidy(given_points), centers = tidy(given_centers);
  const Tensor index = usable_index(given_index);
  check_rows("points", points, centers);
  const int64_t count = centers.size(0), dim_size = centers.size(1), n = points.size(0);
  check(count > 0, "centers must hold at least one row");
  const Moments result{new_empty(points, {n}, ScalarType::Long),
                       new_zeros(points, {count}),
                       new_zeros(points, {count, dim_size}),
                       new_zeros(points, {scatter ? count : 0, dim_size, dim_size})};
  if (n == 0) return result;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    const CallIndex<T, dim()> call(in<char>(index), index.numel(), in<T>(centers), count);
    const auto moments = moments_of<T, dim()>(in<T>(points), n, in<T>(centers), call.index, scatter,
                                              out<int64_t>(result[0]));
    moments.write(call.index.order, out<T>(result[1]), out<T>(result[2]),
                  scatter ? out<T>(result[3]) : nullptr);
    return 0;
  });
  return result;
}

void check_row_numbers(const Tensor& rows, int64_t count) {
  check(rows.scalar_type() == ScalarType::Long, "rows must be int64");
  const int64_t* row = in<int64_t>(rows);
  const int64_t entries = rows.numel();
  uint64_t largest = 0;
  for (int64_t i = 0; i < entries; ++i) largest = std::max(largest, uint64_t(row[i]));
  check(entries == 0 || largest < uint64_t(count), "row out of range");
}

// One batch: every point moves its nearest center; `met` counts the points since the restart.
template <class T, int D>
void pull_centers(const std::vector<T>& batch, T* centers, int64_t count, std::vector<T>& met) {
  const CallIndex<T, D> call(nullptr, 0, centers, count);
  const Index& index = call.index;
  const auto moments =
      moments_of<T, D>(batch.data(), batch.size() / D, centers, index, false, nullptr);
  for (int64_t rank = 0; rank < count; ++rank) {
    double sum[1 + D];
    moments.total(rank, 1 + D, sum);
    const int64_t row = index.order[rank];
    met[row] += T(sum[0]);
    for (int d = 0; d < D; ++d) centers[row * D + d] += T(sum[1 + d]) / std::max(met[row], T(1));
  }
}

Tensor kmeans(const Tensor& given_points, const Tensor& given_start, const Tensor& given_rows,
              int64_t batch_size, int64_t restart_every) {
  const Tensor points = tidy(given_points), start = tidy(given_start), rows = tidy(given_rows);
  check_rows("points", points, start);
  check_row_numbers(rows, points.size(0));
  check(batch_size >= 1 && restart_every >= 1 && start.size(0) >= 1,
        "batch_size, restart_every and the number of centers must be 1 or more");
  const Tensor centers = new_empty(start, start.sizes());
  dispatch(start, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    std::copy_n(in<T>(start), start.numel(), out<T>(centers));
    std::vector<T> met(start.size(0)), batch;
    const T* from = in<T>(points);
    const int64_t *row = in<int64_t>(rows), drawn = rows.numel();
    for (int64_t begin = 0, step = 0; begin < drawn; begin += batch_size, ++step) {
      if (step % restart_every == 0) std::fill(met.begin(), met.end(), T(0));
      const int64_t n = std::min(batch_size, drawn - begin);
      batch.resize(n * D);
      for (int64_t i = 0; i < n; ++i)
        std::memcpy(batch.data() + i * D, from + row[begin + i] * D, D * sizeof(T));
      pull_centers<T, D>(batch, out<T>(centers), start.size(0), met);
    }
    return 0;
  });
  return centers;
}

// Places along a Z curve of 2^10 cells an axis, as in `points.morton_order`; ties keep their order.
Tensor z_order(const Tensor& given_points) {
  const Tensor points = tidy(given_points);
  const int64_t n = points.size(0);
  const Tensor order = new_empty(points, {n}, ScalarType::Long);
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim(), kBits = 10;
    constexpr T last = (1 << kBits) - 1;
    Box<T, D> box;
    box.add(in<T>(points), 0, n, 1);
    T edge = std::numeric_limits<T>::min();
    for (int d = 0; d < D; ++d) edge = std::max(edge, box.high[d] - box.low[d]);
    uint32_t spread[1 << kBits] = {};
    for (int cell = 0; cell < 1 << kBits; ++cell)
      for (int bit = 0; bit < kBits; ++bit) spread[cell] |= uint32_t(cell >> bit & 1) << bit * D;
    Sorter sorter;
    sorter.items.resize(n);
    const T* from = in<T>(points);
    for (int64_t i = 0; i < n; ++i) {
      uint32_t key = 0;
      for (int d = 0; d < D; ++d) {
        const T at = (from[i * D + d] - box.low[d]) / edge * last;
        key |= spread[at > 0 ? int32_t(std::min(at, last)) : 0] << d;  // NaN: 0
      }
      sorter.items[i] = uint64_t(key) << 32 | uint64_t(i);
    }
    sorter.sort(kBits * D);
    int64_t* to = out<int64_t>(order);
    for (int64_t i = 0; i < n; ++i) to[i] = int64_t(uint32_t(sorter.items[i]));
    return 0;
  });
  return order;
}

}  // namespace

std::vector<Operator> kmeans_operators() {
  return {
      {"assign(Tensor points, Tensor centers, Tensor index, bool scatter) "
       "-> (Tensor, Tensor, Tensor, Tensor)",
       &boxed<assign>},
      {"kmeans(Tensor points, Tensor start, Tensor rows, int batch_size, int restart_every) "
       "-> Tensor",
       &boxed<kmeans>},
      {"z_order(Tensor points) -> Tensor", &boxed<z_order>},
  };
}

}  // namespace lardhm
