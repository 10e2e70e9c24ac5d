// Eigenvalues and axes of small symmetric matrices, by Jacobi's method.

#pragma once

#include <cmath>
#include <cstdint>
#include <utility>

namespace lardhm {

// D x D elements of L matrices, those of the matrices side by side, so that L lanes of a register turn
// one matrix each.
template <int D, int L>
using Matrices = double[D][D][L];

// Turns columns p and q of matrices, each by its own angle.
template <int D, int L>
inline void turn(const double* c, const double* s, int p, int q, Matrices<D, L>& a) {
  for (int i = 0; i < D; ++i)
    for (int m = 0; m < L; ++m) {
      const double x = a[i][p][m], y = a[i][q][m];
      a[i][p][m] = c[m] * x - s[m] * y, a[i][q][m] = s[m] * x + c[m] * y;
    }
}

// One rotation of the matrices and of their axes, unless they are done, or are diagonal there.
template <int D, int L>
inline void rotate(int p, int q, const double* unfinished, Matrices<D, L>& a,
                   Matrices<D, L>& axes) {
  double c[L], s[L];
  for (int m = 0; m < L; ++m) {
    const double off = a[p][q][m];
    const bool turns = off != 0 && unfinished[m] != 0;
    const double half = (a[q][q][m] - a[p][p][m]) / (2 * (turns ? off : 1));
    const double size = 1 / (std::abs(half) + std::sqrt(half * half + 1));
    const double t = turns ? std::copysign(size, half) : 0;
    c[m] = 1 / std::sqrt(t * t + 1), s[m] = t * c[m];
  }
  turn<D, L>(c, s, p, q, a);
  for (int i = 0; i < D; ++i)
    for (int m = 0; m < L; ++m) {
      const double x = a[p][i][m], y = a[q][i][m];
      a[p][i][m] = c[m] * x - s[m] * y, a[q][i][m] = s[m] * x + c[m] * y;
    }
  turn<D, L>(c, s, p, q, axes);
}

// Of L matrices, which become diagonal: eigenvalues in ascending order, and axes as the columns of
// `axes`, each of length 1.
template <int D, int L>
void jacobi(Matrices<D, L>& a, double (&values)[D][L], Matrices<D, L>& axes) {
  constexpr int kSweeps = 12;
  double size[L] = {}, unfinished[L];
  for (int i = 0; i < D; ++i)
    for (int j = 0; j < D; ++j)
      for (int m = 0; m < L; ++m) {
        axes[i][j][m] = i == j;
        size[m] += a[i][j][m] * a[i][j][m];
      }
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    double rest[L] = {}, some = 0;
    for (int p = 0; p < D; ++p)
      for (int q = p + 1; q < D; ++q)
        for (int m = 0; m < L; ++m) rest[m] += a[p][q][m] * a[p][q][m];
    for (int m = 0; m < L; ++m) {
      unfinished[m] = rest[m] > 1e-36 * size[m];
      some += unfinished[m];
    }
    if (some == 0) break;
    for (int p = 0; p < D; ++p)
      for (int q = p + 1; q < D; ++q) rotate<D, L>(p, q, unfinished, a, axes);
  }
  for (int m = 0; m < L; ++m) {
    for (int i = 0; i < D; ++i) values[i][m] = a[i][i][m];
    for (int i = 0; i < D; ++i)
      for (int j = i + 1; j < D; ++j)
        if (values[j][m] < values[i][m]) {
          std::swap(values[i][m], values[j][m]);
          for (int row = 0; row < D; ++row) std::swap(axes[row][i][m], axes[row][j][m]);
        }
  }
}

}  // namespace lardhm
