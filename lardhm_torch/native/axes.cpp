// Eigenvalues and axes of many small symmetric matrices.

#include <algorithm>
#include <cstdint>
#include <type_traits>

#include "jacobi.h"
#include "tensors.h"
#include "threads.h"

namespace lardhm {
namespace {

template <class T, int D>
void find_axes(const T* matrices, int64_t count, T* values, T* axes) {
  constexpr int64_t kRows = 512;
  run_tasks((count + kRows - 1) / kRows, [&](int64_t task) {
    const int64_t end = std::min(count, (task + 1) * kRows);
    for (int64_t row = task * kRows; row < end; ++row) {
      double matrix[D * D], found[D], columns[D][D];
      for (int i = 0; i < D * D; ++i) matrix[i] = double(matrices[row * D * D + i]);
      jacobi<D>(matrix, found, columns);
      for (int i = 0; i < D; ++i) {
        values[row * D + i] = T(found[i]);
        for (int j = 0; j < D; ++j) axes[(row * D + i) * D + j] = T(columns[i][j]);
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
