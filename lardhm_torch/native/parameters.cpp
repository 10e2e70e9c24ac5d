// Packing the parameters.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "parameters.h"
#include "sorting.h"

namespace lardhm {

// exp(raw) of a register, clamped to the finite range.
template <class T>
inline typename Simd<T>::V lengthscales(typename Simd<T>::V raw) {
  using V = typename Simd<T>::V;
  const V most = ExpConstants<T>::highest - V{};
  const V value = exp_of<T>(raw < most ? raw : most);
  return raw == raw ? value : raw;  // NaN stays
}

template <class T, int D>
Parameters<T, D>::Parameters(const Index& index_, const T* centers_, const T* raw_, const T* weights_,
           Scaling scaling, bool all)
    : index(index_), centers(centers_), raw(raw_), weights(weights_),
      scale(T(std::sqrt(scaling.covariance_scale))), floor(T(scaling.min_lengthscale)) {
  constexpr int64_t kPosition = Layout<D>::position;
  positions.allocate((index.header.count + 1) * kPosition);
  std::fill_n(positions.data + index.header.count * kPosition, kPosition,
              std::numeric_limits<T>::infinity());
  if (raw) shapes.allocate(index.header.count * Layout<D>::shape);
  if (!all) packed.assign(index.blocks, 0);
  if (!all) return;
  run_tasks((index.blocks + kPackGrain - 1) / kPackGrain, [&](int64_t task) {
    const int64_t end = std::min(index.blocks, (task + 1) * kPackGrain);
    for (int64_t block = task * kPackGrain; block < end; ++block) pack(block);
  });
}

template <class T, int D>
void Parameters<T, D>::need(const std::vector<int32_t>& ranks, int64_t size) {
  for (int64_t i = 0; i < size; ++i) {
    char& done = packed[ranks[i] / kBlock];
    if (!done) pack(ranks[i] / kBlock);
    done = 1;
  }
}

template <class T, int D>
void Parameters<T, D>::pack(int64_t block) {
  const int64_t count = index.header.count, first = block * kBlock;
  const int members = int(std::min<int64_t>(kBlock, count - first));
  for (int64_t soon = first + kBlock; soon < std::min(count, first + 2 * kBlock); ++soon) {
    __builtin_prefetch(centers + int64_t(index.order[soon]) * D);
    if (!raw) continue;
    __builtin_prefetch(raw + int64_t(index.order[soon]) * D * D);
    __builtin_prefetch(raw + int64_t(index.order[soon]) * D * D + D * D - 1);
    __builtin_prefetch(weights + index.order[soon]);
  }
  for (int i = 0; i < members; ++i)
    pack_position(centers + int64_t(index.order[first + i]) * D, first + i);
  if (raw) pack_shapes(first, members);
}

// A center that is not finite is farther than any other.
template <class T, int D>
void Parameters<T, D>::pack_position(const T* center, int64_t rank) {
  T* to = positions.data + rank * Layout<D>::position;
  const bool finite = is_finite(center, D);
  for (int d = 0; d < Layout<D>::position; ++d)
    to[d] = d >= D ? T(0) : finite ? center[d] : std::numeric_limits<T>::infinity();
}

template <class T, int D>
void Parameters<T, D>::pack_shapes(int64_t first, int members) {
  using L = Layout<D>;
  alignas(64) T inverse[D][kBlock] = {};
  for (int i = 0; i < members; ++i)
    for (int d = 0; d < D; ++d)
      inverse[d][i] = raw[int64_t(index.order[first + i]) * D * D + d * D + d];
  for (int d = 0; d < D; ++d)
    for (int i = 0; i < kBlock; i += Simd<T>::W) {
      const typename Simd<T>::V length = lengthscales<T>(load<typename Simd<T>::V>(inverse[d] + i));
      const typename Simd<T>::V inverted = T(1) / (scale * (length < floor ? floor : length));
      std::memcpy(inverse[d] + i, &inverted, sizeof(inverted));
    }
  for (int i = 0; i < members; ++i) {
    const int64_t row = index.order[first + i];
    const T* factor = raw + row * D * D;
    T* to = shapes.data + (first + i) * L::shape;
    for (int d = 0; d < D; ++d) to[d] = inverse[d][i];
    to[L::below] = scale * factor[D];
    if (D == 3) {
      to[L::below + 1] = scale * factor[2 * D];
      to[L::below + 2] = scale * factor[2 * D + 1];
    }
    to[L::weight] = weights[row];
  }
}

template struct Parameters<float, 2>;
template struct Parameters<float, 3>;
template struct Parameters<double, 2>;
template struct Parameters<double, 3>;

}  // namespace lardhm
