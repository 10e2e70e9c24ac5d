// Stochastic gradient descent over kept features, batch after batch.
//
// The same arithmetic as `fitting.batch_gradient` and `fitting.descend`, without temporary arrays.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "tensors.h"
#include "threads.h"

namespace lardhm {
namespace {

// What stays the same over a call. Names as in FitConfig.
struct Rates {
  int64_t num_points, batch_size, first_step, total_steps;
  double learning_rate, l1, l2;
  bool decay, preconditioner;
  double at(int64_t step) const {
    return learning_rate * (decay ? 1.0 - double(step) / double(total_steps) : 1.0);
  }
};

// Features, labels and loss factors of all rows.
template <class T>
struct Rows {
  const int32_t* indices;
  const T *values, *labels, *factors;
  int64_t k;
};

// Calls use(j, index) for the K indices of a row, which are read two at a time: half the loads.
template <int K, class Use>
__attribute__((always_inline)) inline void for_indices(const int32_t* index, int64_t any_k,
                                                       const Use& use) {
  const int64_t k = K > 0 ? K : any_k;
  asm("" : "+r"(index));  // prevents gathers of the weights of many rows, which take 1.5 times as long
  for (int64_t j = 0; j + 1 < k; j += 2) {
    uint32_t pair[2];
    uint64_t both;
    std::memcpy(&both, index + j, sizeof(both));
    std::memcpy(pair, &both, sizeof(both));
    use(j, pair[0]);
    use(j + 1, pair[1]);
  }
  if (k % 2) use(k - 1, uint32_t(index[k - 1]));
}

constexpr int kTogether = 64;

// Log-odds of `count` rows, every `stride`-th from the first one.
template <class T, int K>
inline void log_odds_of(const Rows<T>& rows, int64_t first, int64_t stride, int count,
                        const T* __restrict weights, T* __restrict at) {
  const int64_t k = K > 0 ? K : rows.k;
  for (int i = 0; i < count; ++i) {
    const T* value = rows.values + (first + i * stride) * k;
    T sum = 0;
    for_indices<K>(rows.indices + (first + i * stride) * k, k,
                   [&](int64_t j, uint32_t index) { sum += value[j] * weights[index]; });
    at[i] = sum;
  }
}

// Probabilities from log-odds, together, so that no row waits for its own sigmoid.
template <class T>
inline void to_probabilities(T* at) {
  using V = typename Simd<T>::V;
  for (int i = 0; i < kTogether; i += Simd<T>::W) {
    const V probability = sigmoid<T>(load<V>(at + i));
    std::memcpy(at + i, &probability, sizeof(probability));
  }
}

// Gradient of the loss of the rows begin .. end with respect to the weights, added to `slope`.
template <class T, int K>
void add_gradient(const Rows<T>& rows, int64_t begin, int64_t end, const T* __restrict weights,
                  T* __restrict slope) {
  const int64_t k = K > 0 ? K : rows.k;
  alignas(64) T at[kTogether] = {};
  for (int64_t first = begin; first < end; first += kTogether) {
    const int count = int(std::min<int64_t>(kTogether, end - first));
    log_odds_of<T, K>(rows, first, 1, count, weights, at);
    to_probabilities(at);
    for (int i = 0; i < count; ++i) {
      const int64_t row = first + i;
      const T* value = rows.values + row * k;
      const T pull = rows.factors[row] * (at[i] - rows.labels[row]);
      for_indices<K>(rows.indices + row * k, k,
                     [&](int64_t j, uint32_t index) { slope[index] += pull * value[j]; });
    }
  }
}

template <class T>
void add_gradient_for(const Rows<T>& rows, int64_t begin, int64_t end, const T* weights, T* slope) {
  switch (rows.k) {
    case 5: return add_gradient<T, 5>(rows, begin, end, weights, slope);
    case 8: return add_gradient<T, 8>(rows, begin, end, weights, slope);
    case 12: return add_gradient<T, 12>(rows, begin, end, weights, slope);
    case 16: return add_gradient<T, 16>(rows, begin, end, weights, slope);
    default: return add_gradient<T, 0>(rows, begin, end, weights, slope);
  }
}

// One step of eq. (4) with the running moments of Adam as preconditioner; clears `slope`.
template <class T>
void descend(const Rates& rates, int64_t step, int64_t rows, int64_t count, T* __restrict slope,
             T* __restrict weights, T* __restrict mean, T* __restrict square) {
  const T share = T(1) / T(rows), decay = T(2 * rates.l2 / double(rates.num_points));
  const T rate = T(rates.at(step)), threshold = T(rates.l1 / double(rates.num_points));
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
    weights[m] = threshold > 0 ? std::copysign(shrunk, moved) : moved;
    slope[m] = 0;
  }
}

using State = Tensors<3>;

bool all_below(int64_t count, const int32_t* index, int64_t size) {
  uint32_t largest = 0;
  for (int64_t i = 0; i < size; ++i) largest = std::max(largest, uint32_t(index[i]));
  return size == 0 || int64_t(largest) < count;
}

// Indices are checked batch by batch, while they are in the cache.
template <class T>
void run_batches(const Rows<T>& rows, int64_t n, int64_t count, const State& state,
                 const Rates& rates) {
  T *weights = out<T>(state[0]), *mean = out<T>(state[1]);
  T* square = out<T>(state[2]);
  std::vector<T> slope(count);
  int64_t step = rates.first_step;
  for (int64_t begin = 0; begin < n; begin += rates.batch_size, ++step) {
    const int64_t end = std::min(n, begin + rates.batch_size);
    check(all_below(count, rows.indices + begin * rows.k, (end - begin) * rows.k),
          "index out of range");
    add_gradient_for<T>(rows, begin, end, weights, slope.data());
    descend<T>(rates, step, end - begin, count, slope.data(), weights, mean, square);
  }
}

void check_descent(const Tensor& indices, const Tensor& values, const Tensor& labels,
                   const Tensor& factors, const State& state) {
  const auto dtype = values.scalar_type();
  const int64_t n = values.size(0), count = state[0].numel();
  bool fits = indices.dim() == 2 && values.dim() == 2 && indices.size(0) == n &&
              values.size(1) == indices.size(1) && labels.numel() == n && factors.numel() == n &&
              labels.scalar_type() == dtype && factors.scalar_type() == dtype &&
              indices.scalar_type() == ScalarType::Int;
  for (const Tensor* t : {&state[0], &state[1], &state[2]})
    fits = fits && t->numel() == count && t->scalar_type() == dtype;
  check(fits, "features, labels, factors and state must agree in size and dtype");
  check(dtype == ScalarType::Double || dtype == ScalarType::Float,
        "values must be float32 or float64");
}

State descent(const Tensor& given_indices, const Tensor& given_values, const Tensor& given_labels,
              const Tensor& given_factors, const Tensor& weights, const Tensor& mean,
              const Tensor& square, int64_t num_points, int64_t batch_size, int64_t first_step,
              int64_t total_steps, double learning_rate, bool decay, bool preconditioner,
              double l1, double l2) {
  const Tensor indices = tidy(given_indices), values = tidy(given_values);
  const Tensor labels = tidy(given_labels), factors = tidy(given_factors);
  check(batch_size >= 1, "batch_size must be 1 or more");
  check_descent(indices, values, labels, factors, {weights, mean, square});
  const State state{copy_of(weights), copy_of(mean), copy_of(square)};
  const Rates rates{num_points, batch_size, first_step, total_steps, learning_rate,
                    l1,         l2,         decay,      preconditioner};
  const int64_t n = values.size(0), k = values.size(1), count = weights.numel();
  const auto run = [&](auto type) {
    using T = decltype(type);
    const Rows<T> rows{in<int32_t>(indices), in<T>(values), in<T>(labels), in<T>(factors), k};
    run_batches<T>(rows, n, count, state, rates);
  };
  values.scalar_type() == ScalarType::Double ? run(double{}) : run(float{});
  return state;
}

// Loss in excess of that of a perfect prediction.
template <class T>
T excess_loss(T log_odds, T label) {
  const T other = 1 - label, size = std::abs(log_odds);
  const T loss = std::max(log_odds, T(0)) - log_odds * label + std::log1p(std::exp(-size));
  return label > 0 && other > 0 ? loss + label * std::log(label) + other * std::log(other) : loss;
}

// Errors of every `stride`-th of the rows: excess losses, or how far probabilities are from labels.
template <class T>
bool write_errors(const Rows<T>& rows, int64_t n, int64_t stride, int64_t count, const T* weights,
                  bool losses, T* to) {
  constexpr int64_t kGrain = 32 * kTogether;
  std::atomic<bool> valid{true};
  run_tasks((n + kGrain - 1) / kGrain, [&](int64_t task) {
    alignas(64) T at[kTogether] = {};
    const int64_t stop = std::min(n, (task + 1) * kGrain);
    for (int64_t i = task * kGrain; i < stop; ++i) {
      __builtin_prefetch(rows.values + i * stride * rows.k);
      if (!all_below(count, rows.indices + i * stride * rows.k, rows.k)) valid = false;
    }
    for (int64_t first = task * kGrain; first < stop && valid; first += kTogether) {
      const int together = int(std::min<int64_t>(kTogether, stop - first));
      log_odds_of<T, 0>(rows, first * stride, stride, together, weights, at);
      if (!losses) to_probabilities(at);
      for (int i = 0; i < together; ++i) {
        const T label = rows.labels[(first + i) * stride];
        to[first + i] = losses ? excess_loss(at[i], label) : std::abs(at[i] - label);
      }
    }
  });
  return valid;
}

Tensor errors(const Tensor& given_indices, const Tensor& given_values, const Tensor& given_labels,
              const Tensor& given_weights, int64_t stride, bool losses) {
  const Tensor indices = tidy(given_indices), values = tidy(given_values);
  const Tensor labels = tidy(given_labels), weights = tidy(given_weights);
  check_descent(indices, values, labels, labels, {weights, weights, weights});
  check(stride >= 1, "stride must be 1 or more");
  const int64_t k = values.size(1), n = (values.size(0) + stride - 1) / stride;
  const Tensor found = new_empty(values, {n});
  const auto run = [&](auto type) {
    using T = decltype(type);
    const Rows<T> rows{in<int32_t>(indices), in<T>(values), in<T>(labels), nullptr, k};
    return write_errors<T>(rows, n, stride, weights.numel(), in<T>(weights), losses, out<T>(found));
  };
  const bool wide = values.scalar_type() == ScalarType::Double;
  check(wide ? run(double{}) : run(float{}), "index out of range");
  return found;
}

}  // namespace

std::vector<Operator> descent_operators() {
  return {
      {"errors(Tensor indices, Tensor values, Tensor labels, Tensor weights, int stride, "
       "bool losses) -> Tensor",
       &boxed<errors>},
      {"descent(Tensor indices, Tensor values, Tensor labels, Tensor factors, Tensor weights, "
       "Tensor mean, Tensor square, int num_points, int batch_size, int first_step, "
       "int total_steps, float learning_rate, bool decay, bool preconditioner, float l1, float l2) "
       "-> (Tensor, Tensor, Tensor)",
       &boxed<descent>},
  };
}

}  // namespace lardhm
