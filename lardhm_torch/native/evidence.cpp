// Evidence of clusters: the points of smallest priority of each, see `learning/evidence.py`.

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "clusters.h"
#include "priority.h"

namespace lardhm {
namespace {

// Rows of the points of each cluster: those of cluster m are rows[first[m]] to rows[first[m + 1]].
struct Groups {
  std::vector<int64_t> first;
  std::vector<int32_t> rows;

  Groups(const int32_t* owners, int64_t n, int64_t count) : first(count + 1, 0) {
    for (int64_t i = 0; i < n; ++i)
      if (owners[i] >= 0 && owners[i] < count) ++first[owners[i] + 1];
    for (int64_t m = 0; m < count; ++m) first[m + 1] += first[m];
    rows.resize(first[count]);
    std::vector<int64_t> next(first.begin(), first.end() - 1);
    for (int64_t i = 0; i < n; ++i)
      if (owners[i] >= 0 && owners[i] < count) rows[next[owners[i]]++] = int32_t(i);
  }
};

template <class T, int D>
struct Candidate {
  uint32_t rank;
  T point[D];

  bool operator<(const Candidate& other) const {
    if (rank != other.rank) return rank < other.rank;
    return std::lexicographical_compare(point, point + D, other.point, other.point + D);
  }
  bool operator==(const Candidate& other) const {
    return rank == other.rank && std::equal(point, point + D, other.point);
  }
};

// The first candidates as a cluster's evidence; infinity where there are fewer than `size`.
template <class T, int D>
void write(const std::vector<Candidate<T, D>>& found, int64_t size, T* to) {
  const int64_t kept = std::min<int64_t>(size, found.size());
  for (int64_t i = 0; i < kept; ++i) std::copy_n(found[i].point, D, to + i * D);
  std::fill_n(to + kept * D, (size - kept) * D, std::numeric_limits<T>::infinity());
}

// The `size` smallest distinct candidates of a cluster, ascending.
template <class T, int D>
void keep(const T* points, const int32_t* rows, int64_t n, int64_t size,
          std::vector<Candidate<T, D>>& found, T* to) {
  found.resize(n);
  for (int64_t i = 0; i < n; ++i) {
    const T* point = points + int64_t(rows[i]) * D;
    found[i].rank = priority<T, D>(point);
    std::copy_n(point, D, found[i].point);
  }
  if (n > 4 * size) {  // repeated points are rare: the smallest 2 size hold enough distinct ones
    std::nth_element(found.begin(), found.begin() + 2 * size, found.end());
    std::sort(found.begin(), found.begin() + 2 * size);
    const auto end = std::unique(found.begin(), found.begin() + 2 * size);
    if (end - found.begin() >= size) return write(found, size, to);
    found.erase(end, found.begin() + 2 * size);
  }
  std::sort(found.begin(), found.end());
  found.erase(std::unique(found.begin(), found.end()), found.end());
  write(found, size, to);
}

Tensor keep_points(const Tensor& given_points, const Tensor& given_owners, int64_t num_clusters,
                   int64_t size) {
  const Tensor points = tidy(given_points), owners = tidy(given_owners);
  check(points.dim() == 2 && owners.numel() == points.size(0) &&
            owners.scalar_type() == ScalarType::Int && num_clusters >= 0 && size > 0,
        "owners must be (N,) int32, one per point, and size > 0");
  const Tensor kept = new_empty(points, {num_clusters, size, points.size(1)});
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const Groups groups(in<int32_t>(owners), points.size(0), num_clusters);
    constexpr int64_t kGrain = 64;
    run_tasks((num_clusters + kGrain - 1) / kGrain, [&](int64_t task) {
      std::vector<Candidate<T, D>> found;
      for (int64_t m = task * kGrain; m < std::min(num_clusters, (task + 1) * kGrain); ++m)
        keep<T, D>(in<T>(points), groups.rows.data() + groups.first[m],
                   groups.first[m + 1] - groups.first[m], size, found,
                   out<T>(kept) + m * size * D);
    });
    return 0;
  });
  return kept;
}

}  // namespace

std::vector<Operator> evidence_operators() {
  return {
      {"keep_points(Tensor points, Tensor owners, int num_clusters, int size) -> Tensor",
       &boxed<keep_points>},
  };
}

}  // namespace lardhm
