// Eigenvalues and axes of small symmetric matrices, by Jacobi's method.

#pragma once

#include <cmath>
#include <cstdint>
#include <utility>

namespace lardhm {

// Eigenvalues in ascending order, and axes as the columns of `axes`, each of length 1.
template <int D>
void jacobi(const double* matrix, double* values, double (&axes)[D][D]) {
  constexpr int kSweeps = 12;
  double a[D][D], size = 0;
  for (int i = 0; i < D; ++i)
    for (int j = 0; j < D; ++j) {
      a[i][j] = matrix[i * D + j];
      axes[i][j] = i == j;
      size += a[i][j] * a[i][j];
    }
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    double rest = 0;
    for (int p = 0; p < D; ++p)
      for (int q = p + 1; q < D; ++q) rest += a[p][q] * a[p][q];
    if (!(rest > 1e-36 * size)) break;
    for (int p = 0; p < D; ++p)
      for (int q = p + 1; q < D; ++q) {
        if (a[p][q] == 0) continue;
        const double half = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const double t = std::copysign(1 / (std::abs(half) + std::sqrt(half * half + 1)), half);
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (int i = 0; i < D; ++i) {
          const double x = a[i][p], y = a[i][q];
          a[i][p] = c * x - s * y, a[i][q] = s * x + c * y;
        }
        for (int i = 0; i < D; ++i) {
          const double x = a[p][i], y = a[q][i];
          a[p][i] = c * x - s * y, a[q][i] = s * x + c * y;
          const double z = axes[i][p], w = axes[i][q];
          axes[i][p] = c * z - s * w, axes[i][q] = s * z + c * w;
        }
      }
  }
  for (int i = 0; i < D; ++i) values[i] = a[i][i];
  for (int i = 0; i < D; ++i)
    for (int j = i + 1; j < D; ++j)
      if (values[j] < values[i]) {
        std::swap(values[i], values[j]);
        for (int row = 0; row < D; ++row) std::swap(axes[row][i], axes[row][j]);
      }
}

}  // namespace lardhm
