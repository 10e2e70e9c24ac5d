// Gradients of the log-odds or the probability, by points, centers, raw factors and weights.

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "kernel.h"
#include "tensors.h"

namespace lardhm {
namespace {

enum Wanted { kPoints = 1, kCenters = 2, kScaleTril = 4, kWeights = 8 };

// Gradients: `sums` holds, for each cluster by rank, those of weight, center and factor.
template <class T, int D>
struct BackwardVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  using L = Layout<D>;
  const T *positions, *shapes, *grad;
  bool probability, fades;
  int64_t wanted;
  T *grad_points, *sums;
  std::vector<char> bytes;

  BackwardVisitor(const Parameters<T, D>& parameters, const T* grad_, bool probability_,
                  bool fades_, int64_t wanted_, T* grad_points_, T* sums_)
      : positions(parameters.positions.data), shapes(parameters.shapes.data), grad(grad_),
        probability(probability_), fades(fades_), wanted(wanted_), grad_points(grad_points_),
        sums(sums_) {}

  void invalid(int64_t row) override {
    if (!(wanted & kPoints)) return;
    for (int d = 0; d < D; ++d) grad_points[row * D + d] = std::numeric_limits<T>::quiet_NaN();
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    bytes.resize((selected.size + 1) * kTerms * sizeof(V) + 64);
    V* terms = reinterpret_cast<V*>((reinterpret_cast<uintptr_t>(bytes.data()) + 63) / 64 * 64);
    const V g = incoming(packet, selected, terms);
    V towards[D] = {}, reach = {};
    for (int64_t j = 0; j < selected.size; ++j)
      cluster(packet, selected.rank[j], g, terms + j * kTerms, towards, reach);
    if (fades) farthest(packet, selected, terms, reach, towards);
    if (!(wanted & kPoints)) return;
    for (int lane = 0; lane < packet.lanes; ++lane)
      for (int d = 0; d < D; ++d) grad_points[packet.row(lane) * D + d] = -towards[d][lane];
  }

  // Of each cluster: z, the faded and masked kernel value, the fraction t of the k-th squared distance,
  // the masked kernel value times the slope of the fade.
  static constexpr int kTerms = D + 3;

  // Gradient that reaches the log-odds; fills in the terms of the clusters.
  V incoming(const Packet<T, D>& packet, const Selection& selected, V* terms) const {
    V sum = {}, g = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* center = positions + int64_t(selected.rank[j]) * L::position;
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      V* z = terms + j * kTerms;
      whiten<T, D>(packet, center, shape, z);
      const V kernel = mask_of<T>(selected.bits[j]) ? kernel_of<T, D>(z) : V{};
      z[D + 1] = squared_distance(packet, center) * packet.fading;
      z[D] = kernel * fade_of<T>(z[D + 1]);
      z[D + 2] = kernel * fade_slope<T>(z[D + 1]);
      sum += z[D] * shape[L::weight];
    }
    for (int lane = 0; lane < packet.lanes; ++lane) g[lane] = grad[packet.row(lane)];
    if (!probability) return g;
    const V p = sigmoid<T>(sum);
    return g * p * sigmoid<T>(-sum);
  }

  // Adds the gradient of one cluster; y = inv(L)^T z, d log_odds / dc = w phi y, dL = w phi y z^T.
  // The fade adds 2 w kernel slope (c - x) / d_k^2 to the center, and its part by d_k^2 to `reach`.
  void cluster(const Packet<T, D>& packet, int32_t rank, V g, const V* z, V* towards, V& reach) {
    const T* shape = shapes + int64_t(rank) * L::shape;
    T* sum = sums + int64_t(rank) * L::gradient;
    const V by_weight = g * z[D];
    if (wanted & kWeights) sum[0] += sum_lanes<T>(by_weight);
    if (!(wanted & (kPoints | kCenters | kScaleTril))) return;
    const T* below = shape + L::below;
    const V share = by_weight * shape[L::weight];
    V y[D];
    y[D - 1] = share * z[D - 1] * shape[D - 1];
    if constexpr (D == 3) y[1] = (share * z[1] - y[2] * below[2]) * shape[1];
    y[0] = share * z[0] - y[1] * below[0];
    if constexpr (D == 3) y[0] -= y[2] * below[1];
    y[0] *= shape[0];
    const V by_fade = g * shape[L::weight] * z[D + 2] * packet.fading;
    reach -= by_fade * z[D + 1];
    const T* center = positions + int64_t(rank) * L::position;
    for (int d = 0; d < D; ++d) {
      const V moved = y[d] + T(2) * by_fade * (center[d] - packet.x[d]);
      towards[d] += moved;
      if (wanted & kCenters) sum[1 + d] += sum_lanes<T>(moved);
    }
    if (!(wanted & kScaleTril)) return;
    T* factor = sum + 1 + D;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j) *factor++ += sum_lanes<T>(y[i] * z[j]);
  }

  // The gradient by d_k^2, shared by the centers at that distance, as `amax` shares it.
  void farthest(const Packet<T, D>& packet, const Selection& selected, const V* terms, V reach,
                V* towards) {
    if (!(wanted & (kPoints | kCenters))) return;
    V most = {}, tied = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const V t = mask_of<T>(selected.bits[j]) ? terms[j * kTerms + D + 1] : V{};
      most = t > most ? t : most;
    }
    for (int64_t j = 0; j < selected.size; ++j)
      tied += mask_of<T>(selected.bits[j]) & (terms[j * kTerms + D + 1] >= most) ? T(1) - V{} : V{};
    for (int64_t j = 0; j < selected.size; ++j) {
      const I at_it = mask_of<T>(selected.bits[j]) & (terms[j * kTerms + D + 1] >= most);
      if (!bits_of<T>(at_it)) continue;
      const T* center = positions + int64_t(selected.rank[j]) * L::position;
      T* sum = sums + int64_t(selected.rank[j]) * L::gradient;
      for (int d = 0; d < D; ++d) {
        const V moved = at_it ? T(2) * reach / tied * (center[d] - packet.x[d]) : V{};
        towards[d] += moved;
        if (wanted & kCenters) sum[1 + d] += sum_lanes<T>(moved);
      }
    }
  }
};

// From the kernel's factor L to the raw one: the diagonal is its logarithm, and flat at the floor.
template <class T, int D>
void raw_gradient(const Parameters<T, D>& parameters, int64_t rank, const T* factor, T* raw) {
  const T* shape = parameters.shapes.data + rank * Layout<D>::shape;
  const T* given = parameters.raw + int64_t(parameters.index.order[rank]) * D * D;
  const T log_floor = std::log(parameters.floor);
  for (int i = 0; i < D; ++i)
    for (int j = 0; j <= i; ++j, ++factor)
      raw[i * D + j] = j < i                           ? *factor * parameters.scale
                       : given[i * D + i] >= log_floor ? *factor / shape[i]
                                                       : T(0);
}

// Sums of the parts, from rank order to the tensors' rows.
template <class T, int D>
void scatter_gradients(const Parameters<T, D>& parameters, const T* sums, int64_t parts, T* weights,
                       T* centers, T* raw) {
  using L = Layout<D>;
  const int64_t count = parameters.index.header.count;
  run_tasks((count + kPackGrain - 1) / kPackGrain, [&](int64_t task) {
    const int64_t end = std::min(count, (task + 1) * kPackGrain);
    for (int64_t rank = task * kPackGrain; rank < end; ++rank) {
      if (!parameters.packed.empty() && !parameters.packed[rank / kBlock]) continue;
      T sum[L::gradient] = {};
      for (int64_t part = 0; part < parts; ++part)
        for (int i = 0; i < L::gradient; ++i)
          sum[i] += sums[(part * count + rank) * L::gradient + i];
      const int64_t row = parameters.index.order[rank];
      if (weights) weights[row] = sum[0];
      for (int d = 0; centers && d < D; ++d) centers[row * D + d] = sum[1 + d];
      if (raw) raw_gradient<T, D>(parameters, rank, sum + 1 + D, raw + row * D * D);
    }
  });
}

using Gradients = Tensors<4>;

Tensor like_or_empty(const Tensor& tensor, bool wanted) {
  return wanted ? new_zeros(tensor, tensor.sizes()) : new_empty(tensor, {0});
}


Gradients occupancy_backward(const Tensor& given_grad, const Tensor& given_points,
                             const Tensor& centers, const Tensor& raw, const Tensor& weights,
                             int64_t k, double covariance_scale, double min_lengthscale,
                             const Tensor& index, bool probability, int64_t wanted) {
  check_k(k);
  const Tensor grad = tidy(given_grad), points = tidy(given_points);
  check_rows("points", points, centers);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  check(grad.dim() == 1 && grad.size(0) == points.size(0) &&
            grad.scalar_type() == points.scalar_type(),
        "grad must be (N,), one per point, of the points' dtype");
  const int64_t count = centers.size(0), n = points.size(0);
  const Gradients result{
      like_or_empty(points, wanted & kPoints), like_or_empty(map.centers, wanted & kCenters),
      like_or_empty(map.raw, wanted & kScaleTril), like_or_empty(map.weights, wanted & kWeights)};
  k = std::min(k, count);
  if (k == 0 || n == 0) return result;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_parameters<T, dim()>(map, n, [&](Parameters<T, dim()>& parameters) {
      const int64_t size = count * Layout<dim()>::gradient;
      const int64_t parts = parts_of(n, size * sizeof(T), parameters);
      std::vector<T> sums((wanted & ~kPoints) ? size * parts : 0);
      std::vector<BackwardVisitor<T, dim()>> visitors;
      for (int64_t part = 0; part < parts; ++part)
        visitors.emplace_back(parameters, in<T>(grad), probability, k > 1 && k < count, wanted,
                              (wanted & kPoints) ? out<T>(result[0]) : nullptr,
                              sums.data() + part * size);
      visit_parts<T, dim()>(in<T>(points), n, parameters, k, each_of<T, dim()>(visitors));
      if (wanted & ~kPoints)
        scatter_gradients<T, dim()>(parameters, sums.data(), parts,
                                    (wanted & kWeights) ? out<T>(result[3]) : nullptr,
                                    (wanted & kCenters) ? out<T>(result[1]) : nullptr,
                                    (wanted & kScaleTril) ? out<T>(result[2]) : nullptr);
    });
    return 0;
  });
  return result;
}

}  // namespace

std::vector<Operator> gradients_operators() {
  return {
      {"occupancy_backward(Tensor grad, Tensor points, Tensor centers, Tensor raw_scale_tril, "
       "Tensor weights, int k, float covariance_scale, float min_lengthscale, Tensor index, "
       "bool probability, int wanted) -> (Tensor, Tensor, Tensor, Tensor)",
       &boxed<occupancy_backward>},
  };
}

}  // namespace lardhm
