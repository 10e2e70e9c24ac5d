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

// inv(before) raw-factor, in place of the factor: forward substitution, column by column.
template <int D>
void solve(const Matrix<D> before, Matrix<D> factors) {
  for (int column = 0; column < D; ++column)
    for (int i = column; i < D; ++i) {
      double rest = factors[i][column];
      for (int j = column; j < i; ++j) rest -= before[i][j] * factors[j][column];
      factors[i][column] = rest / before[i][i];
    }
}

// A raw factor moved by the change of the moments, in place: L -> after inv(before) L, as
// `cluster_matching.moved_factors`; without a scatter before: the factor of the moments. False where
// a covariance is not positive definite.
template <int D, class T, class After>
bool moved_factor(const T* scatter_before, double count_before, const After* scatter_after,
                  double count_after, double floor, T* raw) {
  Matrix<D> before, after, tuned = {};
  bool definite = factor<D>(scatter_after, count_after, floor, after);
  if (scatter_before) {
    definite = factor<D>(scatter_before, count_before, floor, before) && definite;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j)
        tuned[i][j] = i == j ? std::exp(double(raw[i * D + i])) : double(raw[i * D + j]);
    solve<D>(before, tuned);
  } else {
    for (int d = 0; d < D; ++d) tuned[d][d] = 1;
  }
  for (int i = 0; i < D; ++i)
    for (int j = 0; j < D; ++j) {
      double sum = 0;
      for (int m = j; m <= i; ++m) sum += after[i][m] * tuned[m][j];
      raw[i * D + j] = T(i == j ? std::log(sum) : sum);
    }
  return definite;
}

}  // namespace lardhm
