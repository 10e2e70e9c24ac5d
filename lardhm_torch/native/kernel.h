// The LARD kernel of a packet and one cluster: phi(x) = exp(-|inv(L) (x - c)|^2 / 2).

#pragma once

#include <cstring>

#include "packets.h"

namespace lardhm {

constexpr double kFading = 0.5;  // as features.FADING

// Whitened offset inv(L) offset; the shape is that of one cluster, or one for each lane.
template <class T, int D, class Shape>
LARDHM_INLINE void whiten_offset(const typename Simd<T>::V* offset, const Shape* shape,
                                 typename Simd<T>::V* z) {
  const Shape* below = shape + Layout<D>::below;
  z[0] = offset[0] * shape[0];
  z[1] = (offset[1] - z[0] * below[0]) * shape[1];
  if constexpr (D == 3) z[2] = (offset[2] - z[0] * below[1] - z[1] * below[2]) * shape[2];
}

// Fade factor of a neighbor at the fraction t < 1 of the k-th center's squared distance, ...
template <class T>
LARDHM_INLINE typename Simd<T>::V fade_within(typename Simd<T>::V t) {
  using V = typename Simd<T>::V;
  const V left = T(1 / kFading) - t * T(1 / kFading);
  const V u = left < T(1) ? left : V{} + T(1);
  return u * u * (T(3) - T(2) * u);
}

// ... and at any, as `features.neighbor_fade`.
template <class T>
LARDHM_INLINE typename Simd<T>::V fade_of(typename Simd<T>::V t) {
  using V = typename Simd<T>::V;
  return t < T(1) ? fade_within<T>(t) : V{};
}

// Whitened offset z = inv(L) (x - c) of a packet from one cluster.
template <class T, int D>
LARDHM_INLINE void whiten(const Packet<T, D>& packet, const T* center, const T* shape,
                          typename Simd<T>::V* z) {
  typename Simd<T>::V offset[D];
  for (int d = 0; d < D; ++d) offset[d] = packet.x[d] - center[d];
  whiten_offset<T, D>(offset, shape, z);
}

template <class T, int D>
LARDHM_INLINE typename Simd<T>::V kernel_of(const typename Simd<T>::V* z) {
  typename Simd<T>::V squared = z[0] * z[0];
  for (int d = 1; d < D; ++d) squared += z[d] * z[d];
  return exp_of<T>(squared * T(-0.5));
}

// Its derivative by t.
template <class T>
LARDHM_INLINE typename Simd<T>::V fade_slope(typename Simd<T>::V t) {
  using V = typename Simd<T>::V;
  const V u = (T(1) - t) * T(1 / kFading);
  return u > 0 ? (u < T(1) ? u * (u - T(1)) * T(6 / kFading) : V{}) : V{};
}

// A packet's kernel values of one cluster, faded.
template <class T, int D>
inline typename Simd<T>::V feature_of(const Packet<T, D>& packet, const T* center,
                                      const T* shape) {
  typename Simd<T>::V z[D];
  whiten<T, D>(packet, center, shape, z);
  return kernel_of<T, D>(z) * fade_of<T>(squared_distance(packet, center) * packet.fading);
}

template <class T, int D>
inline void store_rows(typename Simd<T>::V value, const Packet<T, D>& packet, T* to) {
  T lane_value[Simd<T>::W];
  std::memcpy(lane_value, &value, sizeof(value));
  for (int lane = 0; lane < packet.lanes; ++lane) to[packet.row(lane)] = lane_value[lane];
}

}  // namespace lardhm
