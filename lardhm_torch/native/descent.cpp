// One pass of stochastic gradient descent over kept features, and the kernel values it needs.
//
// The same arithmetic as `fitting.batch_gradient` and `fitting.descend`, without an array a step.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <tuple>
#include <vector>

namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class T>
const T* in(const Tensor& tensor) {
  return static_cast<const T*>(tensor.const_data_ptr());
}

template <class T>
T* out(const Tensor& tensor) {
  return static_cast<T*>(tensor.mutable_data_ptr());
}

// phi = exp(-|inv(L) (x - c)|^2 / 2) of every point and each of its neighbors.
template <class T>
void kernel_values_of(const T* points, const T* centers, const T* factors, const int64_t* indices,
                      int64_t begin, int64_t end, int64_t k, int64_t dim, T* values) {
  std::vector<T> z(dim);
  for (int64_t i = begin; i < end; ++i)
    for (int64_t j = 0; j < k; ++j) {
      const int64_t m = indices[i * k + j];
      const T* factor = factors + m * dim * dim;
      T squared = 0;
      for (int64_t row = 0; row < dim; ++row) {
        T rest = points[i * dim + row] - centers[m * dim + row];
        for (int64_t column = 0; column < row; ++column) rest -= factor[row * dim + column] * z[column];
        z[row] = rest / factor[row * dim + row];
        squared += z[row] * z[row];
      }
      values[i * k + j] = std::exp(T(-0.5) * squared);
    }
}

Tensor kernel_values(const Tensor& given_points, const Tensor& given_centers,
                     const Tensor& given_factors, const Tensor& given_indices) {
  const auto tidy = [](const Tensor& t) { return torch::stable::contiguous(t); };
  const Tensor points = tidy(given_points), centers = tidy(given_centers);
  const Tensor factors = tidy(given_factors), indices = tidy(given_indices);
  const auto dtype = points.scalar_type();
  const int64_t n = points.size(0), dim = points.size(1), count = centers.size(0);
  const int64_t k = indices.size(1);
  STD_TORCH_CHECK(indices.size(0) == n && centers.size(1) == dim &&
                      factors.numel() == count * dim * dim && centers.scalar_type() == dtype &&
                      factors.scalar_type() == dtype && indices.scalar_type() == ScalarType::Long,
                  "points, centers, factors and indices must agree in size and dtype");
  for (int64_t i = 0; i < n * k; ++i)
    STD_TORCH_CHECK(uint64_t(in<int64_t>(indices)[i]) < uint64_t(count), "index out of range");
  const Tensor values = torch::stable::new_empty(points, {n, k});
  torch::stable::parallel_for(0, n, 2048, [&](int64_t begin, int64_t end) {
    if (dtype == ScalarType::Double)
      kernel_values_of<double>(in<double>(points), in<double>(centers), in<double>(factors),
                               in<int64_t>(indices), begin, end, k, dim, out<double>(values));
    else
      kernel_values_of<float>(in<float>(points), in<float>(centers), in<float>(factors),
                              in<int64_t>(indices), begin, end, k, dim, out<float>(values));
  });
  return values;
}

// What stays the same over a pass. Names as in FitConfig.
struct Rates {
  int64_t batch_size, first_step, total_steps;
  double learning_rate, l1, l2;
  bool decay, preconditioner;
  double at(int64_t step) const {
    return learning_rate * (decay ? 1.0 - double(step) / double(total_steps) : 1.0);
  }
};

// Gradient of the rows' loss with respect to the weights, added to `slope`.
template <class T>
void add_gradient(const int64_t* rows, int64_t n, int64_t k, const int64_t* indices,
                  const T* values, const T* labels, const T* factors, const T* weights, T* slope) {
  for (int64_t i = 0; i < n; ++i) {
    const int64_t row = rows[i];
    const int64_t* index = indices + row * k;
    const T* value = values + row * k;
    T log_odds = 0;
    for (int64_t j = 0; j < k; ++j) log_odds += value[j] * weights[index[j]];
    const T residual = factors[row] * (T(1) / (T(1) + std::exp(-log_odds)) - labels[row]);
    for (int64_t j = 0; j < k; ++j) slope[index[j]] += residual * value[j];
  }
}

// One step of eq. (4) with the running moments of Adam as preconditioner; clears `slope`.
template <class T>
void descend(const Rates& rates, int64_t step, int64_t num_points, int64_t rows, int64_t count,
             T* slope, T* weights, T* mean, T* square) {
  const T share = T(1) / T(rows), decay = T(2 * rates.l2 / double(num_points));
  const T rate = T(rates.at(step)), threshold = T(rates.l1 / double(num_points));
  const T mean_bias = T(1 / (1 - std::pow(0.9, double(step + 1))));
  const T square_bias = T(1 / (1 - std::pow(0.99, double(step + 1))));
  for (int64_t m = 0; m < count; ++m) {
    const T g = slope[m] * share + decay * weights[m];
    T reach = rate, move = g;
    if (rates.preconditioner) {
      mean[m] = T(0.9) * mean[m] + T(0.1) * g;
      square[m] = T(0.99) * square[m] + T(0.01) * g * g;
      reach = rate / (std::sqrt(square[m] * square_bias) + T(1e-10));
      move = mean[m] * mean_bias;
    }
    const T moved = weights[m] - reach * move;
    const T shrunk = std::max(std::abs(moved) - reach * threshold, T(0));
    weights[m] = rates.l1 > 0 ? std::copysign(shrunk, moved) : moved;
    slope[m] = 0;
  }
}

template <class T>
Tensor copy_of(const Tensor& tensor) {
  Tensor copy = torch::stable::new_empty(tensor, tensor.sizes());
  std::memcpy(copy.mutable_data_ptr(), tensor.const_data_ptr(), tensor.numel() * sizeof(T));
  return copy;
}

using State = std::tuple<Tensor, Tensor, Tensor>;

template <class T>
State descent_pass_of(const Tensor& indices, const Tensor& values, const Tensor& labels,
                      const Tensor& factors, const Tensor& order, const State& start,
                      const Rates& rates) {
  const State state{copy_of<T>(std::get<0>(start)), copy_of<T>(std::get<1>(start)),
                    copy_of<T>(std::get<2>(start))};
  T *weights = out<T>(std::get<0>(state)), *mean = out<T>(std::get<1>(state));
  T* square = out<T>(std::get<2>(state));
  const int64_t n = order.numel(), k = indices.size(1), count = std::get<0>(state).numel();
  std::vector<T> slope(count);
  int64_t step = rates.first_step;
  for (int64_t begin = 0; begin < n; begin += rates.batch_size, ++step) {
    const int64_t rows = std::min(rates.batch_size, n - begin);
    add_gradient<T>(in<int64_t>(order) + begin, rows, k, in<int64_t>(indices), in<T>(values),
                    in<T>(labels), in<T>(factors), weights, slope.data());
    descend<T>(rates, step, n, rows, count, slope.data(), weights, mean, square);
  }
  return state;
}

void check_pass(const Tensor& indices, const Tensor& values, const Tensor& labels,
                const Tensor& factors, const Tensor& order, const State& state) {
  const auto dtype = values.scalar_type();
  const int64_t n = order.numel(), count = std::get<0>(state).numel();
  bool fits = indices.dim() == 2 && values.dim() == 2 && indices.size(0) == n &&
              values.size(0) == n && values.size(1) == indices.size(1) && labels.numel() == n &&
              factors.numel() == n && labels.scalar_type() == dtype &&
              factors.scalar_type() == dtype && indices.scalar_type() == ScalarType::Long &&
              order.scalar_type() == ScalarType::Long;
  for (const Tensor* t : {&std::get<0>(state), &std::get<1>(state), &std::get<2>(state)})
    fits = fits && t->numel() == count && t->scalar_type() == dtype;
  STD_TORCH_CHECK(fits, "features, labels, factors, order and state must agree in size and dtype");
  for (int64_t i = 0; i < indices.numel(); ++i)
    STD_TORCH_CHECK(uint64_t(in<int64_t>(indices)[i]) < uint64_t(count), "index out of range");
  for (int64_t i = 0; i < n; ++i)
    STD_TORCH_CHECK(uint64_t(in<int64_t>(order)[i]) < uint64_t(n), "row out of range");
}

State descent_pass(const Tensor& given_indices, const Tensor& given_values,
                   const Tensor& given_labels, const Tensor& given_factors,
                   const Tensor& given_order, const Tensor& weights, const Tensor& mean,
                   const Tensor& square, int64_t batch_size, int64_t first_step,
                   int64_t total_steps, double learning_rate, bool decay, bool preconditioner,
                   double l1, double l2) {
  const auto tidy = [](const Tensor& t) { return torch::stable::contiguous(t); };
  const Tensor indices = tidy(given_indices), values = tidy(given_values);
  const Tensor labels = tidy(given_labels), factors = tidy(given_factors);
  const Tensor order = tidy(given_order);
  const State start{tidy(weights), tidy(mean), tidy(square)};
  check_pass(indices, values, labels, factors, order, start);
  STD_TORCH_CHECK(batch_size >= 1, "batch_size must be 1 or more");
  const Rates rates{batch_size, first_step, total_steps, learning_rate, l1, l2, decay,
                    preconditioner};
  if (values.scalar_type() == ScalarType::Double)
    return descent_pass_of<double>(indices, values, labels, factors, order, start, rates);
  STD_TORCH_CHECK(values.scalar_type() == ScalarType::Float, "values must be float32 or float64");
  return descent_pass_of<float>(indices, values, labels, factors, order, start, rates);
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(lardhm, m) {
  m.def("kernel_values(Tensor points, Tensor centers, Tensor factors, Tensor indices) -> Tensor");
  m.def(
      "descent_pass(Tensor indices, Tensor values, Tensor labels, Tensor factors, Tensor order, "
      "Tensor weights, Tensor mean, Tensor square, int batch_size, int first_step, "
      "int total_steps, float learning_rate, bool decay, bool preconditioner, float l1, float l2) "
      "-> (Tensor, Tensor, Tensor)");
}

STABLE_TORCH_LIBRARY_IMPL(lardhm, CPU, m) {
  m.impl("kernel_values", TORCH_BOX(&kernel_values));
  m.impl("descent_pass", TORCH_BOX(&descent_pass));
}
