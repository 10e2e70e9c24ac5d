// Eigenvalues of small symmetric matrices.

#pragma once

#include <cmath>
#include <utility>

namespace lardhm {

// By Jacobi's method: ascending values, and their vectors as columns.
template <int D>
struct Eigen {
  double values[D], vectors[D][D] = {};

  explicit Eigen(const double* matrix) {
    constexpr int kSweeps = 12;
    double a[D][D];
    for (int i = 0; i < D; ++i) {
      vectors[i][i] = 1;
      for (int j = 0; j < D; ++j) a[i][j] = matrix[i * D + j];
    }
    for (int sweep = 0; sweep < kSweeps; ++sweep) {
      bool is_diagonal = true;
      for (int p = 0; p < D; ++p)
        for (int q = p + 1; q < D; ++q)
          if (a[p][q] != 0) {
            rotate(a, p, q);
            is_diagonal = false;
          }
      if (is_diagonal) break;
    }
    for (int i = 0; i < D; ++i) values[i] = a[i][i];
    for (int i = 0; i < D; ++i)
      for (int j = i + 1; j < D; ++j)
        if (values[j] < values[i]) {
          std::swap(values[i], values[j]);
          for (int row = 0; row < D; ++row) std::swap(vectors[row][i], vectors[row][j]);
        }
  }

 private:
  void rotate(double (*a)[D], int p, int q) {
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
      const double z = vectors[i][p], w = vectors[i][q];
      vectors[i][p] = c * z - s * w, vectors[i][q] = s * z + c * w;
    }
  }
};

}  // namespace lardhm
