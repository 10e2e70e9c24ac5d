// Between torch tensors and the search: checks, dispatch by dtype and dimension.

#pragma once

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "search.h"
#include "tensor.h"

namespace lardhm {

[[noreturn]] inline void fail(const std::string& message) { throw std::runtime_error(message); }

inline void check(bool holds, const char* rule) {
  if (!holds) fail(rule);
}

inline Tensor tidy(const Tensor& tensor) { return contiguous(tensor); }

// A contiguous copy of a float32 or float64 tensor.
inline Tensor copy_of(const Tensor& tensor) {
  const Tensor from = tidy(tensor), copy = new_empty(tensor, tensor.sizes());
  const int64_t bytes = from.scalar_type() == ScalarType::Double ? 8 : 4;
  std::memcpy(copy.mutable_data_ptr(), from.const_data_ptr(), from.numel() * bytes);
  return copy;
}

template <class T>
const T* in(const Tensor& tensor) {
  return static_cast<const T*>(tensor.const_data_ptr());
}

template <class T>
T* out(const Tensor& tensor) {
  return static_cast<T*>(tensor.mutable_data_ptr());
}

inline void check_rows(const char* name, const Tensor& tensor, const Tensor& centers) {
  if (tensor.dim() != 2 || tensor.size(1) != centers.size(1))
    fail(std::string(name) + " must be (N, D) like the centers; got " +
         std::to_string(tensor.dim()) + " dimensions");
  if (tensor.scalar_type() != centers.scalar_type())
    fail(std::string(name) + " must have the dtype of the centers");
}

// Calls use.template operator()<T, D>() for the dtype and dimension of the centers.
template <class Use>
auto dispatch(const Tensor& centers, const Use& use) {
  check(centers.dim() == 2 && (centers.size(1) == 2 || centers.size(1) == 3),
        "centers must be (M, 2) or (M, 3)");
  check(centers.size(0) < (int64_t(1) << 30), "centers must be fewer than 2^30");
  const bool plane = centers.size(1) == 2;
  const ScalarType type = centers.scalar_type();
  check(type == ScalarType::Float || type == ScalarType::Double,
        "centers must be float32 or float64");
  if (type == ScalarType::Float)
    return plane ? use(float{}, std::integral_constant<int, 2>{})
                 : use(float{}, std::integral_constant<int, 3>{});
  return plane ? use(double{}, std::integral_constant<int, 2>{})
               : use(double{}, std::integral_constant<int, 3>{});
}

inline void check_k(int64_t k) {
  if (k < 1) fail("k must be at least 1; got " + std::to_string(k));
}

inline Tensor usable_index(const Tensor& index) {
  check(index.scalar_type() == ScalarType::Byte, "index must be a uint8 tensor");
  return tidy(index);
}

// The tensors of a map, checked and contiguous; an `index` of other centers is ignored.
struct MapTensors {
  Tensor centers, raw, weights, index;
  Scaling scaling;

  MapTensors(const Tensor& centers_, const Tensor& raw_, const Tensor& weights_,
             const Tensor& index_, double covariance_scale, double min_lengthscale)
      : centers(tidy(centers_)), raw(tidy(raw_)), weights(tidy(weights_)),
        index(usable_index(index_)), scaling{covariance_scale, min_lengthscale} {
    const int64_t count = centers.size(0), dim = centers.size(1);
    check(raw.dim() == 3 && raw.size(0) == count && raw.size(1) == dim &&
              raw.size(2) == dim,
          "raw_scale_tril must be (M, D, D), one factor per center");
    check(weights.dim() == 1 && weights.size(0) == count,
          "weights must be (M,), one per center");
    check(raw.scalar_type() == centers.scalar_type() &&
              weights.scalar_type() == centers.scalar_type(),
          "raw_scale_tril and weights must have the dtype of the centers");
    check(covariance_scale > 0 && min_lengthscale >= 0,
          "covariance_scale must be > 0 and min_lengthscale 0 or more");
  }
};

constexpr int64_t kPointsOfFew = 64;  // fewer than clusters / 64: parameters are packed on demand

// Runs `work(parameters)` with all of a map's parameters, for a query of n points.
template <class T, int D, class Work>
void with_parameters(const MapTensors& map, int64_t n, const Work& work) {
  const CallIndex<T, D> call(in<char>(map.index), map.index.numel(), in<T>(map.centers),
                             map.centers.size(0));
  Parameters<T, D> parameters(call.index, in<T>(map.centers), in<T>(map.raw), in<T>(map.weights),
                              map.scaling, n >= map.centers.size(0) / kPointsOfFew);
  work(parameters);
}

}  // namespace lardhm
