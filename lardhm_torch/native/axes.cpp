// Eigenvalues and axes of many small symmetric matrices.

#include <algorithm>
#include <cstdint>
#include <type_traits>

#include "jacobi.h"
#include "tensors.h"
#include "threads.h"

namespace lardhm {
namespace {

constexpr int kMatrices = 8;  // at a time

template <class T, int D>
void find_axes(const T* matrices, int64_t count, T* values, T* axes) {
  constexpr int64_t kRows = 64 * kMatrices;
  run_tasks((count + kRows - 1) / kRows, [&](int64_t task) {
    const int64_t end = std::min(count, (task + 1) * kRows);
    for (int64_t first = task * kRows; first < end; first += kMatrices) {
      const int64_t members = std::min<int64_t>(kMatrices, end - first);
      Matrices<D, kMatrices> matrix = {}, columns;
      double found[D][kMatrices];
      for (int64_t m = 0; m < members; ++m)
        for (int i = 0; i < D * D; ++i)
          matrix[i / D][i % D][m] = double(matrices[(first + m) * D * D + i]);
      jacobi<D, kMatrices>(matrix, found, columns);
      for (int64_t m = 0; m < members; ++m)
        for (int i = 0; i < D; ++i) {
          values[(first + m) * D + i] = T(found[i][m]);
          for (int j = 0; j < D; ++j) axes[((first + m) * D + i) * D + j] = T(columns[i][j][m]);
        }
    }
  });
}

Tensors<2> symmetric_axes(const Tensor& given) {
  const Tensor matrices = tidy(given);
  check(matrices.dim() == 3 && matrices.size(1) == matrices.size(2) &&
            (matrices.size(1) == 2 || matrices.size(1) == 3),
        "matrices must be (M, 2, 2) or (M, 3, 3)");
  const bool wide = matrices.scalar_type() == ScalarType::Double;
  check(wide || matrices.scalar_type() == ScalarType::Float,
        "matrices must be float32 or float64");
  const int64_t count = matrices.size(0), dim = matrices.size(1);
  const Tensors<2> result{new_empty(matrices, {count, dim}), new_empty(matrices, {count, dim, dim})};
  const auto run = [&](auto type, auto size) {
    using T = decltype(type);
    find_axes<T, size()>(in<T>(matrices), count, out<T>(result[0]), out<T>(result[1]));
  };
  const auto of_type = [&](auto type) {
    if (dim == 2)
      run(type, std::integral_constant<int, 2>{});
    else
      run(type, std::integral_constant<int, 3>{});
  };
  wide ? of_type(double{}) : of_type(float{});
  return result;
}

}  // namespace

std::vector<Operator> axes_operators() {
  return {{"symmetric_axes(Tensor matrices) -> (Tensor, Tensor)", &boxed<symmetric_axes>}};
}

}  // namespace lardhm
