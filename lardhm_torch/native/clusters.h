// Clusters given by their moments: checks, and the factors of their covariances.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "tensors.h"

namespace lardhm {

inline void check_moments(const Tensor& counts, const Tensor& means, const Tensor& scatters,
                          const Tensor& like) {
  const int64_t size = like.size(0), dim = like.size(1);
  check(counts.scalar_type() == ScalarType::Long && counts.numel() == size &&
            means.dim() == 2 && means.size(0) == size && means.size(1) == dim &&
            scatters.numel() == size * dim * dim &&
            means.scalar_type() == like.scalar_type() &&
            scatters.scalar_type() == like.scalar_type(),
        "counts (M,) int64, means (M, D) and scatters (M, D, D) must be of one size");
}

// Lower triangles, D rows of D; what is above the diagonal is never read.
template <int D>
using Matrix = double[D][D];

// As `clustering.factor_covariances`: of scatter / (count - 1) with a ridge. False where that is
// not positive definite.
template <int D, class T>
bool factor(const T* scatter, double count, double floor, Matrix<D> lower) {
  const double share = 1 / std::max(count - 1, 1.0);
  double largest = double(scatter[0]) * share, product = 1;
  for (int d = 1; d < D; ++d) largest = std::max(largest, double(scatter[d * D + d]) * share);
  const double ridge = floor * floor + 1e-6 * largest;
  for (int i = 0; i < D; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = double(scatter[i * D + j]) * share + (i == j ? ridge : 0);
      for (int m = 0; m < j; ++m) sum -= lower[i][m] * lower[j][m];
      lower[i][j] = i == j ? std::sqrt(sum) : sum / lower[j][j];
    }
  for (int d = 0; d < D; ++d) product *= lower[d][d];
  return product > 0;
}

}  // namespace lardhm
