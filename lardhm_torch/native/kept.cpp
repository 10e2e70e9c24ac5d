// Points kept by clusters: their number, moments, and clusters that follow them; see
// `learning/evidence.py`.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "clusters.h"
#include "jacobi.h"
#include "priority.h"

namespace lardhm {
namespace {

constexpr int64_t kGrain = 512;

template <class Work>
void for_rows(int64_t count, const Work& work) {
  run_tasks((count + kGrain - 1) / kGrain, [&](int64_t task) {
    const int64_t end = std::min(count, (task + 1) * kGrain);
    for (int64_t row = task * kGrain; row < end; ++row) work(row);
  });
}

void check_evidence(const Tensor& evidence) {
  check(evidence.dim() == 3 && (evidence.size(2) == 2 || evidence.size(2) == 3),
        "evidence must be (M, E, 2) or (M, E, 3)");
}

// Calls use(T, D) for the dtype and dimension of evidence.
template <class Use>
void with_evidence(const Tensor& evidence, const Use& use) {
  check_evidence(evidence);
  const bool wide = evidence.scalar_type() == ScalarType::Double;
  check(wide || evidence.scalar_type() == ScalarType::Float,
        "evidence must be float32 or float64");
  const auto of_type = [&](auto type) {
    if (evidence.size(2) == 2)
      use(type, std::integral_constant<int, 2>{});
    else
      use(type, std::integral_constant<int, 3>{});
  };
  wide ? of_type(double{}) : of_type(float{});
}

// Kept points come first; the rest is infinity.
template <class T, int D>
int64_t count_kept(const T* points, int64_t size) {
  const auto is_kept = [&](int64_t i) { return points[i * D] != std::numeric_limits<T>::infinity(); };
  if (size == 0 || is_kept(size - 1)) return size;
  int64_t low = 0, high = size - 1;  // the first one missing is in low .. high
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (is_kept(middle))
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

Tensor kept_counts(const Tensor& given) {
  const Tensor evidence = tidy(given);
  const int64_t count = evidence.size(0), size = evidence.size(1);
  const Tensor counts = new_empty(evidence, {count}, ScalarType::Long);
  with_evidence(evidence, [&](auto type, auto dim) {
    using T = decltype(type);
    for_rows(count, [&](int64_t row) {
      out<int64_t>(counts)[row] =
          count_kept<T, dim()>(in<T>(evidence) + row * size * dim(), size);
    });
  });
  return counts;
}

Tensors<2> kept_points(const Tensor& given, const Tensor& given_rows) {
  const Tensor evidence = tidy(given), rows = tidy(given_rows);
  check(rows.scalar_type() == ScalarType::Long, "rows must be int64");
  const int64_t count = rows.numel(), size = evidence.size(1);
  for (int64_t i = 0; i < count; ++i)
    check(in<int64_t>(rows)[i] >= 0 && in<int64_t>(rows)[i] < evidence.size(0),
          "rows must be those of the evidence");
  std::vector<int64_t> first(count + 1, 0);
  Tensor points, owners;
  with_evidence(evidence, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const T* all = in<T>(evidence);
    for (int64_t i = 0; i < count; ++i)
      first[i + 1] = first[i] + count_kept<T, D>(all + in<int64_t>(rows)[i] * size * D, size);
    points = new_empty(evidence, {first[count], D});
    owners = new_empty(evidence, {first[count]}, ScalarType::Long);
    for_rows(count, [&](int64_t i) {
      const int64_t row = in<int64_t>(rows)[i], kept = first[i + 1] - first[i];
      std::copy_n(all + row * size * D, kept * D, out<T>(points) + first[i] * D);
      std::fill_n(out<int64_t>(owners) + first[i], kept, row);
    });
  });
  return {points, owners};
}

// The largest priority of the points that clusters keep, found when it is first asked for.
template <class T, int D>
class LastPriorities {
  static constexpr uint32_t kUnknown = ~0u, kAny = kUnknown - 1;
  const T* evidence;
  const bool* cleared;
  int64_t size;
  std::vector<std::atomic<uint32_t>> found;

 public:
  LastPriorities(const T* evidence_, int64_t count, int64_t size_, const bool* cleared_)
      : evidence(evidence_), cleared(cleared_), size(size_), found(count) {
    for (auto& one : found) one.store(kUnknown, std::memory_order_relaxed);
  }

  // Of a cluster that has room, or that loses its points: larger than all priorities.
  uint32_t of(int64_t row) {
    uint32_t last = found[row].load(std::memory_order_relaxed);
    if (last != kUnknown) return last;
    const T* points = evidence + row * size * D;
    last = 0;
    if (cleared[row] || count_kept<T, D>(points, size) < size)
      last = kAny;
    else
      for (int64_t j = 0; j < size; ++j) last = std::max(last, priority<T, D>(points + j * D));
    found[row].store(last, std::memory_order_relaxed);
    return last;
  }
};

// How many points each cluster keeps already, and which points it can keep, see `evidence.kept_again`.
Tensors<2> kept_again(const Tensor& given_points, const Tensor& given_owners, const Tensor& given,
                      const Tensor& given_cleared) {
  const Tensor points = tidy(given_points), owners = tidy(given_owners), evidence = tidy(given);
  const Tensor cleared = tidy(given_cleared);
  const int64_t n = points.size(0), count = evidence.size(0), size = evidence.size(1);
  check(owners.scalar_type() == ScalarType::Long && owners.numel() == n &&
            points.scalar_type() == evidence.scalar_type() && points.size(1) == evidence.size(2),
        "points must be (N, D) like the evidence, owners (N,) int64");
  check(cleared.scalar_type() == ScalarType::Bool && cleared.numel() >= count && size > 0,
        "cleared must be bool, one per cluster");
  const Tensor again = new_zeros(evidence, {cleared.numel()}, ScalarType::Long);
  const Tensor enters = new_empty(evidence, {n}, ScalarType::Bool);
  std::vector<char> is_kept(n, 0);
  with_evidence(evidence, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    LastPriorities<T, D> last(in<T>(evidence), count, size, in<bool>(cleared));
    for_rows(n, [&](int64_t i) {
      const int64_t row = in<int64_t>(owners)[i];
      out<bool>(enters)[i] = row >= 0;
      if (row < 0 || row >= count) return;
      const T *point = in<T>(points) + i * D, *kept = in<T>(evidence) + row * size * D;
      const bool is_late = priority<T, D>(point) > last.of(row);
      for (int64_t j = 0; j < size && !is_late && !is_kept[i]; ++j, kept += D)
        is_kept[i] = std::equal(point, point + D, kept);
      out<bool>(enters)[i] = !is_late && !is_kept[i];
    });
  });
  for (int64_t i = 0; i < n; ++i)
    if (is_kept[i]) ++out<int64_t>(again)[in<int64_t>(owners)[i]];
  return {again, enters};
}

// Moments of the kept points of one cluster, in double precision.
template <class T, int D>
struct KeptMoments {
  double count, mean[D], scatter[D * D];

  KeptMoments(const T* points, int64_t size) {
    const int64_t kept = count_kept<T, D>(points, size);
    double sum[D] = {};
    count = double(kept);
    std::fill_n(scatter, D * D, 0.0);
    for (int64_t i = 0; i < kept; ++i)
      for (int d = 0; d < D; ++d) sum[d] += double(points[i * D + d]) - double(points[d]);
    for (int d = 0; d < D; ++d)
      mean[d] = double(points[d]) + sum[d] / std::max(count, 1.0);
    for (int64_t i = 0; i < kept; ++i)
      for (int a = 0; a < D; ++a)
        for (int b = 0; b <= a; ++b)
          scatter[a * D + b] += (double(points[i * D + a]) - mean[a]) * (double(points[i * D + b]) - mean[b]);
    for (int a = 0; a < D; ++a)
      for (int b = 0; b < a; ++b) scatter[b * D + a] = scatter[a * D + b];
  }
};

using Moments = Tensors<3>;

Moments kept_moments(const Tensor& given) {
  const Tensor evidence = tidy(given);
  const int64_t count = evidence.size(0), size = evidence.size(1), dim = evidence.size(2);
  const Moments result{new_empty(evidence, {count}, ScalarType::Long),
                       new_empty(evidence, {count, dim}),
                       new_empty(evidence, {count, dim, dim})};
  with_evidence(evidence, [&](auto type, auto dimension) {
    using T = decltype(type);
    constexpr int D = dimension();
    for_rows(count, [&](int64_t row) {
      const KeptMoments<T, D> found(in<T>(evidence) + row * size * D, size);
      out<int64_t>(result[0])[row] = int64_t(found.count);
      for (int d = 0; d < D; ++d) out<T>(result[1])[row * D + d] = T(found.mean[d]);
      for (int i = 0; i < D * D; ++i)
        out<T>(result[2])[row * D * D + i] = T(found.scatter[i]);
    });
  });
  return result;
}

// Clusters that follow their kept points: (centers, means, scatters, raw factors).
Tensors<4> follow_kept(
    const Tensor& given, const Tensor& given_counts, const Tensor& given_centers,
    const Tensor& given_means, const Tensor& given_scatters, const Tensor& given_raw,
    const Tensor& given_known, double floor) {
  const Tensor evidence = tidy(given), counts = tidy(given_counts), known = tidy(given_known);
  const Tensor centers = copy_of(given_centers), means = copy_of(given_means);
  const Tensor scatters = copy_of(given_scatters), raw = copy_of(given_raw);
  check_moments(counts, means, scatters, centers);
  check_moments(counts, means, raw, centers);
  const int64_t count = evidence.size(0), size = evidence.size(1);
  check(means.size(0) == count && known.numel() == count &&
            known.scalar_type() == ScalarType::Bool && evidence.size(2) == means.size(1) &&
            evidence.scalar_type() == means.scalar_type(),
        "evidence (M, E, D) and known (M,) bool must be of the size of the clusters");
  std::atomic<bool> definite{true};
  with_evidence(evidence, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    for_rows(count, [&](int64_t row) {
      const KeptMoments<T, D> found(in<T>(evidence) + row * size * D, size);
      if (found.count == 0) return;
      const double represented = double(in<int64_t>(counts)[row]);
      const double share = std::max(represented - 1, 1.0) / std::max(found.count - 1, 1.0);
      T *mean = out<T>(means) + row * D, *center = out<T>(centers) + row * D;
      T *scatter = out<T>(scatters) + row * D * D, before[D * D];
      std::copy_n(scatter, D * D, before);
      for (int d = 0; d < D; ++d) {
        center[d] += T(found.mean[d]) - mean[d];
        mean[d] = T(found.mean[d]);
      }
      for (int i = 0; i < D * D; ++i) scatter[i] = T(found.scatter[i] * share);
      const bool is_known = in<bool>(known)[row];
      if (!moved_factor<D>(is_known ? before : nullptr, represented, scatter, represented, floor,
                           out<T>(raw) + row * D * D))
        definite = false;
    });
  });
  check(definite, "a covariance is not positive definite");
  return {centers, means, scatters, raw};
}

// Direction of the largest eigenvalue of a symmetric matrix; its largest component is positive.
template <int D>
void longest_axis(const double* matrix, double* axis) {
  Matrices<D, 1> one, axes;
  double values[D][1];
  for (int i = 0; i < D * D; ++i) one[i / D][i % D][0] = matrix[i];
  jacobi<D, 1>(one, values, axes);
  int largest = 0;
  for (int i = 1; i < D; ++i)
    if (std::abs(axes[i][D - 1][0]) > std::abs(axes[largest][D - 1][0])) largest = i;
  const double sign = axes[largest][D - 1][0] < 0 ? -1 : 1;
  for (int i = 0; i < D; ++i) axis[i] = sign * axes[i][D - 1][0];
}

// The kept points of each cluster, divided at their mean along the longest axis.
Tensors<2> halves(const Tensor& given) {
  const Tensor evidence = tidy(given);
  const int64_t count = evidence.size(0), size = evidence.size(1);
  const Tensors<2> result{new_empty(evidence, evidence.sizes()),
                          new_empty(evidence, evidence.sizes())};
  with_evidence(evidence, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    for_rows(count, [&](int64_t row) {
      const T* points = in<T>(evidence) + row * size * D;
      T* to[2] = {out<T>(result[0]) + row * size * D, out<T>(result[1]) + row * size * D};
      T* end[2] = {to[0] + size * D, to[1] + size * D};
      const KeptMoments<T, D> found(points, size);
      double axis[D];
      longest_axis<D>(found.scatter, axis);
      for (int64_t i = 0; i < int64_t(found.count); ++i, points += D) {
        double along = 0;
        for (int d = 0; d < D; ++d) along += (double(points[d]) - found.mean[d]) * axis[d];
        T*& half = to[along > 0 ? 0 : 1];
        half = std::copy_n(points, D, half);
      }
      for (int i = 0; i < 2; ++i) std::fill(to[i], end[i], std::numeric_limits<T>::infinity());
    });
  });
  return result;
}

}  // namespace

std::vector<Operator> kept_operators() {
  return {
      {"kept_counts(Tensor evidence) -> Tensor", &boxed<kept_counts>},
      {"kept_points(Tensor evidence, Tensor rows) -> (Tensor, Tensor)", &boxed<kept_points>},
      {"kept_again(Tensor points, Tensor owners, Tensor evidence, Tensor cleared) -> (Tensor, Tensor)",
       &boxed<kept_again>},
      {"halves(Tensor evidence) -> (Tensor, Tensor)", &boxed<halves>},
      {"kept_moments(Tensor evidence) -> (Tensor, Tensor, Tensor)", &boxed<kept_moments>},
      {"follow_kept(Tensor evidence, Tensor counts, Tensor centers, Tensor means, Tensor scatters, "
       "Tensor raw_scale_tril, Tensor known, float floor) -> (Tensor, Tensor, Tensor, Tensor)",
       &boxed<follow_kept>},
  };
}

}  // namespace lardhm
