// Fine-tuning over kept neighbors, batch after batch: forward, backward and Adam in one pass.
//
// The same arithmetic as `tuning_steps.plain_steps`.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "neighbor_lanes.h"
#include "tensors.h"

namespace lardhm {
namespace tuning {

// What stays the same over a call. Names as in `tuning_steps.Plan`.
struct Plan {
  const double *rates, *penalties;  // by column
  int64_t num_points, batch_size, first_step, total_steps, warm_up;
  Scaling scaling;
  bool fades;
  double fraction(int64_t step) const {
    return std::min(1.0, double(step + 1) / double(warm_up)) *
           std::max(0.0, 1 - double(step) / double(total_steps));
  }
};

// What stays the same over a step: factors on the running mean and on the root of the running mean square,
// and of the penalty, by column.
template <class T>
struct Step {
  T rates[16], penalties[16], square_scale;

  Step(const Plan& plan, int64_t step, int columns)
      : square_scale(T(1 / std::sqrt(1 - std::pow(0.99, double(step + 1))))) {
    const double mean_bias = 1 - std::pow(0.9, double(step + 1));
    for (int g = 0; g < columns; ++g) {
      rates[g] = T(plan.rates[g] * plan.fraction(step) / mean_bias);
      penalties[g] = T(2 * plan.penalties[g] / double(plan.num_points));
    }
  }
};

template <class T>
struct Samples {
  const T* points;
  const int32_t* indices;
  const T *labels, *factors;
  int64_t k;
};

// Offsets, running means and mean squares of the gradient, all (M, G), and what they are added to.
template <class T>
struct Table {
  const T *start, *unit;
  T *offsets, *mean, *square;
  int64_t count;
};

// Adds the gradients of the mean loss of the rows begin .. end, of a batch of `size`, to the sums.
template <class T, int D>
void add_gradients(const Samples<T>& samples, int64_t begin, int64_t end, int64_t size, bool fades,
                   const T* records, T* sums) {
  Lanes<T, D> lanes(samples.k);
  const T share = T(1) / T(size);
  for (int64_t row = begin; row < end; ++row) {
    const T* x = samples.points + row * D;
    const int32_t* index = samples.indices + row * samples.k;
    lanes.read(index, records);
    const T farthest = lanes.forward(x);
    const T fading = T(1) / (farthest + std::numeric_limits<T>::min());
    const T log_odds = lanes.log_odds(fading, fades);
    const T probability = sigmoid<T>(typename Simd<T>::V{} + log_odds)[0];
    const T pull = samples.factors[row] * share * (probability - samples.labels[row]);
    lanes.backward(x, pull, farthest, fading, fades);
    lanes.add_to(index, sums);
  }
}

// The cluster's parameters with the current offsets applied.
template <class T, int D>
void write_record(const Table<T>& table, const Scaling& scaling, int64_t m, T* record) {
  constexpr int G = kColumns<D>;
  T value[G];
  for (int g = 0; g < G; ++g)
    value[g] = table.start[m * G + g] + table.unit[m * G + g] * table.offsets[m * G + g];
  const T scale = T(std::sqrt(scaling.covariance_scale)), floor = T(scaling.min_lengthscale);
  for (int d = 0; d < D; ++d) record[d] = value[1 + d];
  int below = Record<D>::below;
  const T* factor = value + 1 + D;
  for (int i = 0; i < D; ++i)
    for (int j = 0; j <= i; ++j, ++factor) {
      if (i == j)
        record[Record<D>::inverse + i] = 1 / (scale * std::max(std::exp(*factor), floor));
      else
        record[below++] = scale * *factor;
    }
  record[Record<D>::weight] = value[0];
}

// One step of Adam on a cluster, from the gradient by the kernel's parameters.
template <class T, int D>
void step_cluster(const Table<T>& table, const Step<T>& step, const Scaling& scaling, int64_t m,
                  T* grad) {
  constexpr int G = kColumns<D>;
  const T scale = T(std::sqrt(scaling.covariance_scale)), floor = T(scaling.min_lengthscale);
  for (int i = 0, g = 1 + D; i < D; ++i)
    for (int j = 0; j <= i; ++j, ++g) {
      const int64_t at = m * G + g;
      if (i != j) {
        grad[g] *= scale;
        continue;
      }
      const T size = std::exp(table.start[at] + table.unit[at] * table.offsets[at]);
      grad[g] *= size >= floor ? scale * size : T(0);
    }
  for (int g = 0; g < G; ++g) {
    const int64_t at = m * G + g;
    const T offset = table.offsets[at];
    const T unit = table.unit[at];
    const T penalized = g == 0 ? (table.start[at] + unit * offset) * unit : offset;
    const T slope = unit * grad[g] + step.penalties[g] * penalized;
    table.mean[at] = T(0.9) * table.mean[at] + T(0.1) * slope;
    table.square[at] = T(0.99) * table.square[at] + T(0.01) * slope * slope;
    const T size = std::sqrt(table.square[at]) * step.square_scale + T(1e-8);
    table.offsets[at] = offset - step.rates[g] * table.mean[at] / size;
  }
}

template <class T, int D>
void run_batches(const Samples<T>& samples, int64_t n, const Table<T>& table, const Plan& plan) {
  constexpr int64_t kGrain = 1024, kStride = Record<D>::stride;
  const int64_t count = table.count, parts = num_threads();
  AlignedArray<T> records;
  records.allocate(count * kStride);
  std::vector<T> sums(parts * count * kStride);
  const auto clusters = [&](const auto& work) {
    run_tasks((count + kGrain - 1) / kGrain, [&](int64_t task) {
      const int64_t end = std::min(count, (task + 1) * kGrain);
      for (int64_t m = task * kGrain; m < end; ++m) work(m);
    });
  };
  clusters([&](int64_t m) { write_record<T, D>(table, plan.scaling, m, records.data + m * kStride); });
  int64_t step = plan.first_step;
  for (int64_t begin = 0; begin < n; begin += plan.batch_size, ++step) {
    const int64_t size = std::min(n - begin, plan.batch_size);
    run_tasks(parts, [&](int64_t part) {
      add_gradients<T, D>(samples, begin + size * part / parts, begin + size * (part + 1) / parts,
                          size, plan.fades, records.data, sums.data() + part * count * kStride);
    });
    const Step<T> now(plan, step, kColumns<D>);
    clusters([&](int64_t m) {
      T grad[kStride] = {};
      for (int64_t part = 0; part < parts; ++part) {
        T* sum = sums.data() + (part * count + m) * kStride;
        for (int g = 0; g < kStride; ++g) grad[g] += sum[g];
        std::fill(sum, sum + kStride, T(0));
      }
      step_cluster<T, D>(table, now, plan.scaling, m, grad);
      write_record<T, D>(table, plan.scaling, m, records.data + m * kStride);
    });
  }
}

using State = Tensors<3>;

void check_state(const Tensor& points, const Tensor& start, std::initializer_list<const Tensor*> like) {
  const int64_t dim = points.size(1);
  check(start.dim() == 2 && start.size(1) == 1 + dim + dim * (dim + 1) / 2 &&
            start.scalar_type() == points.scalar_type(),
        "start must be (M, 1 + D + D (D + 1) / 2), of the dtype of the points");
  for (const Tensor* tensor : like)
    check(tensor->dim() == 2 && tensor->size(0) == start.size(0) &&
              tensor->size(1) == start.size(1) && tensor->scalar_type() == start.scalar_type(),
          "unit, offsets, mean and square must be like start");
}

void check_neighbors(const Tensor& points, const Tensor& indices, int64_t count) {
  check(points.dim() == 2 && (points.size(1) == 2 || points.size(1) == 3),
        "points must be (N, 2) or (N, 3)");
  check(indices.dim() == 2 && indices.size(0) == points.size(0) &&
            indices.scalar_type() == ScalarType::Int && indices.size(1) >= 1,
        "indices must be (N, K) int32, K at least 1");
  const int32_t* index = in<int32_t>(indices);
  const int64_t entries = indices.numel();
  uint32_t largest = 0;
  for (int64_t i = 0; i < entries; ++i) largest = std::max(largest, uint32_t(index[i]));
  check(entries == 0 || int64_t(largest) < count, "index out of range");
}

State tuning_steps(const Tensor& given_points, const Tensor& given_indices,
                   const Tensor& given_labels, const Tensor& given_factors,
                   const Tensor& given_start, const Tensor& given_unit, const Tensor& offsets,
                   const Tensor& mean, const Tensor& square, const Tensor& given_rates,
                   const Tensor& given_penalties, int64_t num_points, int64_t batch_size,
                   int64_t first_step, int64_t total_steps, int64_t warm_up,
                   double covariance_scale, double min_lengthscale) {
  const Tensor points = tidy(given_points), indices = tidy(given_indices);
  const Tensor labels = tidy(given_labels), factors = tidy(given_factors);
  const Tensor start = tidy(given_start), unit = tidy(given_unit);
  const Tensor rates = tidy(given_rates), penalties = tidy(given_penalties);
  check(batch_size >= 1 && warm_up >= 1, "batch_size and warm_up must be 1 or more");
  check_neighbors(points, indices, start.size(0));
  check_state(points, start, {&unit, &offsets, &mean, &square});
  check(labels.numel() == points.size(0) && factors.numel() == points.size(0) &&
            labels.scalar_type() == points.scalar_type() &&
            factors.scalar_type() == points.scalar_type(),
        "labels and factors must be (N,), of the dtype of the points");
  check(rates.scalar_type() == ScalarType::Double && penalties.scalar_type() == ScalarType::Double &&
            rates.numel() == start.size(1) && penalties.numel() == start.size(1),
        "rates and penalties must be float64, one for each column");
  const State state{copy_of(offsets), copy_of(mean), copy_of(square)};
  const int64_t k = indices.size(1), count = start.size(0);
  const Plan plan{in<double>(rates), in<double>(penalties), num_points, batch_size, first_step,
                  total_steps, warm_up, {covariance_scale, min_lengthscale}, k > 1 && k < count};
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    const Samples<T> samples{in<T>(points), in<int32_t>(indices), in<T>(labels), in<T>(factors), k};
    const Table<T> table{in<T>(start), in<T>(unit), out<T>(state[0]),
                         out<T>(state[1]), out<T>(state[2]), count};
    run_batches<T, dim()>(samples, points.size(0), table, plan);
    return 0;
  });
  return state;
}

// Kernel values of each point's neighbors, with the parameters of the table and the current offsets.
Tensor tuned_features(const Tensor& given_points, const Tensor& given_indices,
                      const Tensor& given_start, const Tensor& given_unit,
                      const Tensor& given_offsets, double covariance_scale,
                      double min_lengthscale) {
  const Tensor points = tidy(given_points), indices = tidy(given_indices);
  const Tensor start = tidy(given_start), unit = tidy(given_unit), offsets = tidy(given_offsets);
  check_neighbors(points, indices, start.size(0));
  check_state(points, start, {&unit, &offsets});
  const int64_t n = points.size(0), k = indices.size(1), count = start.size(0);
  const Scaling scaling{covariance_scale, min_lengthscale};
  const Tensor values = new_empty(points, {n, k});
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int64_t D = dim(), kGrain = 4096, kStride = Record<D>::stride;
    const Table<T> table{in<T>(start), in<T>(unit), const_cast<T*>(in<T>(offsets)),
                         nullptr,      nullptr,     count};
    AlignedArray<T> records;
    records.allocate(count * kStride);
    for (int64_t m = 0; m < count; ++m)
      write_record<T, D>(table, scaling, m, records.data + m * kStride);
    run_tasks((n + kGrain - 1) / kGrain, [&](int64_t task) {
      Lanes<T, D> lanes(k);
      for (int64_t row = task * kGrain; row < std::min(n, (task + 1) * kGrain); ++row) {
        lanes.read(in<int32_t>(indices) + row * k, records.data);
        const T farthest = lanes.forward(in<T>(points) + row * D);
        const T fading = T(1) / (farthest + std::numeric_limits<T>::min());
        lanes.write_values(fading, k > 1 && k < count, out<T>(values) + row * k);
      }
    });
    return 0;
  });
  return values;
}

}  // namespace tuning

std::vector<Operator> tuning_operators() {
  return {
      {"tuning_steps(Tensor points, Tensor indices, Tensor labels, Tensor factors, Tensor start, "
       "Tensor unit, Tensor offsets, Tensor mean, Tensor square, Tensor rates, Tensor penalties, "
       "int num_points, int batch_size, int first_step, int total_steps, int warm_up, "
       "float covariance_scale, float min_lengthscale) -> (Tensor, Tensor, Tensor)",
       &boxed<tuning::tuning_steps>},
      {"tuned_features(Tensor points, Tensor indices, Tensor start, Tensor unit, Tensor offsets, "
       "float covariance_scale, float min_lengthscale) -> Tensor",
       &boxed<tuning::tuned_features>},
  };
}

}  // namespace lardhm
