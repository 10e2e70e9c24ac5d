// Evidence of clusters: the points of smallest priority of each, see `learning/evidence.py`.

#include <algorithm>
#include <cstdint>
#include <iterator>
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

// Writes the `size` points of smallest priority, ascending; false if points of equal priority, which
// other rules put in order, are among them.
template <class T, int D>
bool keep_distinct(const T* points, const int32_t* rows, int64_t n, int64_t size,
                   std::vector<uint64_t>& keys, T* to) {
  keys.resize(n);
  for (int64_t i = 0; i < n; ++i)
    keys[i] = uint64_t(priority<T, D>(points + int64_t(rows[i]) * D)) << 32 | uint32_t(rows[i]);
  const auto end = keys.begin() + std::min(n, size + 1);
  if (n > size + 1) std::nth_element(keys.begin(), end - 1, keys.end());
  std::sort(keys.begin(), end);
  for (auto key = keys.begin(); key + 1 < end; ++key)
    if (*key >> 32 == *(key + 1) >> 32) return false;
  const int64_t kept = std::min(n, size);
  for (int64_t i = 0; i < kept; ++i) std::copy_n(points + int64_t(uint32_t(keys[i])) * D, D, to + i * D);
  std::fill_n(to + kept * D, (size - kept) * D, std::numeric_limits<T>::infinity());
  return true;
}

// The `size` smallest distinct candidates of a cluster, ascending.
template <class T, int D>
void keep(const T* points, const int32_t* rows, int64_t n, int64_t size,
          std::vector<uint64_t>& keys, std::vector<Candidate<T, D>>& found, T* to) {
  if (keep_distinct<T, D>(points, rows, n, size, keys, to)) return;
  found.resize(n);
  for (int64_t i = 0; i < n; ++i) {
    const T* point = points + int64_t(rows[i]) * D;
    found[i].rank = priority<T, D>(point);
    std::copy_n(point, D, found[i].point);
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
      std::vector<uint64_t> keys;
      std::vector<Candidate<T, D>> found;
      for (int64_t m = task * kGrain; m < std::min(num_clusters, (task + 1) * kGrain); ++m)
        keep<T, D>(in<T>(points), groups.rows.data() + groups.first[m],
                   groups.first[m + 1] - groups.first[m], size, keys, found,
                   out<T>(kept) + m * size * D);
    });
    return 0;
  });
  return kept;
}

// Candidates for one cluster's evidence: those it keeps, in ascending order, and new ones.
template <class T, int D>
struct Merger {
  int64_t size;
  std::vector<Candidate<T, D>> before, kept, added, merged;

  void read(const T* points) {
    before.clear();
    for (int64_t i = 0; i < size && points[i * D] != std::numeric_limits<T>::infinity(); ++i)
      before.push_back(candidate(points + i * D));
    if (!std::is_sorted(before.begin(), before.end()))  // points that were moved with their map
      std::sort(before.begin(), before.end());
  }

  static Candidate<T, D> candidate(const T* point) {
    Candidate<T, D> found;
    found.rank = priority<T, D>(point);
    std::copy_n(point, D, found.point);
    return found;
  }

  // Number of candidates of the ascending `merged` that are kept and were not before.
  int64_t count_new() const {
    int64_t count = 0;
    auto old = before.begin();
    for (const auto& one : merged) {
      while (old != before.end() && *old < one) ++old;
      count += old == before.end() || !(*old == one);
    }
    return count;
  }

  // Writes the evidence after the rows were added, and returns the number of its new points.
  int64_t merge(const T* points, const int32_t* rows, int64_t n, bool cleared, T* to) {
    kept.clear(), added.clear(), merged.clear();
    if (!cleared) kept = before;
    const bool full = int64_t(kept.size()) == size;
    for (int64_t i = 0; i < n; ++i) {
      const auto one = candidate(points + int64_t(rows[i]) * D);
      if (!full || one < kept.back()) added.push_back(one);
    }
    if (added.empty() && !cleared) {
      write(kept, size, to);
      return 0;
    }
    std::sort(added.begin(), added.end());
    std::merge(kept.begin(), kept.end(), added.begin(), added.end(), std::back_inserter(merged));
    merged.erase(std::unique(merged.begin(), merged.end()), merged.end());
    if (int64_t(merged.size()) > size) merged.resize(size);
    write(merged, size, to);
    return count_new();
  }
};

Tensors<2> add_points(const Tensor& given_evidence, const Tensor& given_cleared,
                      const Tensor& given_points, const Tensor& given_owners) {
  const Tensor evidence = tidy(given_evidence), cleared = tidy(given_cleared);
  const Tensor points = tidy(given_points), owners = tidy(given_owners);
  const int64_t known = evidence.size(0), size = evidence.size(1), dim = evidence.size(2);
  const int64_t count = cleared.numel(), n = points.size(0);
  check(points.dim() == 2 && points.size(1) == dim && owners.numel() == n &&
            points.scalar_type() == evidence.scalar_type() &&
            owners.scalar_type() == ScalarType::Int,
        "points must be (N, D) like the evidence, owners (N,) int32");
  check(cleared.scalar_type() == ScalarType::Bool && count >= known,
        "cleared must be bool, one per cluster");
  const Tensors<2> result{new_empty(evidence, {count, size, dim}),
                          new_empty(evidence, {count}, ScalarType::Long)};
  dispatch(points, [&](auto type, auto dimension) {
    using T = decltype(type);
    constexpr int D = dimension();
    const Groups groups(in<int32_t>(owners), n, count);
    constexpr int64_t kGrain = 64;
    run_tasks((count + kGrain - 1) / kGrain, [&](int64_t task) {
      Merger<T, D> merger{size, {}, {}, {}, {}};
      for (int64_t m = task * kGrain; m < std::min(count, (task + 1) * kGrain); ++m) {
        const int64_t added = groups.first[m + 1] - groups.first[m];
        T* to = out<T>(result[0]) + m * size * D;
        out<int64_t>(result[1])[m] = 0;
        if (m < known && !added && !in<bool>(cleared)[m]) {
          std::copy_n(in<T>(evidence) + m * size * D, size * D, to);
          continue;
        }
        merger.before.clear();
        if (m < known) merger.read(in<T>(evidence) + m * size * D);
        out<int64_t>(result[1])[m] =
            merger.merge(in<T>(points), groups.rows.data() + groups.first[m], added,
                         in<bool>(cleared)[m], to);
      }
    });
    return 0;
  });
  return result;
}

}  // namespace

std::vector<Operator> evidence_operators() {
  return {
      {"keep_points(Tensor points, Tensor owners, int num_clusters, int size) -> Tensor",
       &boxed<keep_points>},
      {"add_points(Tensor evidence, Tensor cleared, Tensor points, Tensor owners) -> (Tensor, "
       "Tensor)",
       &boxed<add_points>},
  };
}

}  // namespace lardhm
