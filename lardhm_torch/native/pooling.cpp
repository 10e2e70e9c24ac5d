// Clusters pooled with the moments of new points, and factors moved by the change.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "clusters.h"

namespace lardhm {
namespace {

// One cluster: the moments of the union, the center and the factor moved as they moved.
template <class T, int D>
struct Pooled {
  double count, mean[D], shift[D], scatter[D * D];

  Pooled(int64_t known, const T* mean_a, const T* scatter_a, int64_t found, const T* mean_b,
         const T* scatter_b) {
    count = double(known + found);
    const double share = double(found) / std::max(count, 1.0), weight = double(known) * share;
    double apart[D];
    for (int d = 0; d < D; ++d) {
      apart[d] = double(mean_b[d]) - double(mean_a[d]);
      shift[d] = share * apart[d];
      mean[d] = double(mean_a[d]) + shift[d];
    }
    for (int i = 0; i < D; ++i)
      for (int j = 0; j < D; ++j)
        scatter[i * D + j] = double(scatter_a[i * D + j]) + double(scatter_b[i * D + j]) +
                             weight * apart[i] * apart[j];
  }

  // False where a covariance is not positive definite.
  bool move(const T* scatter_before, int64_t known, double floor, const T* raw, T* to) const {
    std::copy_n(raw, D * D, to);
    return moved_factor<D>(scatter_before, double(known), scatter, count, floor, to);
  }
};

using Clusters = Tensors<5>;

// (counts, means, scatters, how far the means moved, raw factors) of the clusters of both.
Clusters pool(const Tensor& given_counts, const Tensor& given_means, const Tensor& given_scatters,
              const Tensor& given_raw, const Tensor& found_counts, const Tensor& found_means,
              const Tensor& found_scatters, double floor) {
  const Tensor counts = tidy(given_counts), means = tidy(given_means);
  const Tensor scatters = tidy(given_scatters), raw = tidy(given_raw);
  const Tensor new_counts = tidy(found_counts), new_means = tidy(found_means);
  const Tensor new_scatters = tidy(found_scatters);
  check_moments(counts, means, scatters, means);
  check_moments(new_counts, new_means, new_scatters, means);
  check_moments(counts, means, raw, means);
  const Clusters result{new_empty(counts, counts.sizes()),
                        new_empty(means, means.sizes()),
                        new_empty(scatters, scatters.sizes()),
                        new_empty(means, means.sizes()),
                        new_empty(raw, raw.sizes())};
  dispatch(means, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    constexpr int64_t kGrain = 512;
    const int64_t size = means.size(0);
    std::atomic<bool> definite{true};
    run_tasks((size + kGrain - 1) / kGrain, [&](int64_t task) {
      for (int64_t m = task * kGrain; m < std::min(size, (task + 1) * kGrain); ++m) {
        const int64_t known = in<int64_t>(counts)[m], found = in<int64_t>(new_counts)[m];
        const T* before = in<T>(scatters) + m * D * D;
        const Pooled<T, D> pooled(known, in<T>(means) + m * D, before, found,
                                  in<T>(new_means) + m * D, in<T>(new_scatters) + m * D * D);
        out<int64_t>(result[0])[m] = known + found;
        for (int d = 0; d < D; ++d) {
          out<T>(result[1])[m * D + d] = T(pooled.mean[d]);
          out<T>(result[3])[m * D + d] = T(pooled.shift[d]);
        }
        for (int i = 0; i < D * D; ++i)
          out<T>(result[2])[m * D * D + i] = T(pooled.scatter[i]);
        if (!pooled.move(before, known, floor, in<T>(raw) + m * D * D,
                         out<T>(result[4]) + m * D * D))
          definite = false;
      }
    });
    check(definite, "a pooled covariance is not positive definite");
    return 0;
  });
  return result;
}

}  // namespace

std::vector<Operator> pooling_operators() {
  return {
      {"pool(Tensor counts, Tensor means, Tensor scatters, Tensor raw_scale_tril, Tensor new_counts, "
       "Tensor new_means, Tensor new_scatters, float floor) "
       "-> (Tensor, Tensor, Tensor, Tensor, Tensor)",
       &boxed<pool>},
  };
}

}  // namespace lardhm
