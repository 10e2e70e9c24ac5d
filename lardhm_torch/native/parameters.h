// Parameters of the clusters by rank, packed once a call.

#pragma once

#include <cstdint>
#include <vector>

#include "index.h"
#include "simd.h"
#include "threads.h"

namespace lardhm {

// Offsets in doubles: position (x, y, z, -) and shape, each in one cache line.
template <int D>
struct Layout {
  static constexpr int position = D == 3 ? 4 : 2;  // center
  static constexpr int shape = D == 3 ? 8 : 4;     // 1 / diagonal, below the diagonal, weight
  static constexpr int below = D, weight = D + D * (D - 1) / 2;
  static constexpr int gradient = D == 3 ? 12 : 8;  // weight, center, factor; rest unused
};

constexpr int64_t kPackGrain = 512;  // blocks packed in one go

// Converts the clusters' raw factors to those of the kernel, L: below the diagonal
// sqrt(covariance_scale) raw, on it sqrt(covariance_scale) max(exp(raw), min_lengthscale).
struct Scaling {
  double covariance_scale = 1, min_lengthscale = 0;
};

// Parameters by rank. Packed all at once, or, for a few points of a large map, a block when it is
// first a candidate. Without factors and weights, positions alone.
template <class T, int D>
struct Parameters {
  const Index& index;
  const T *centers, *raw, *weights;
  T scale, floor;
  AlignedArray<T> positions, shapes;  // the last position is infinitely far, of no cluster
  std::vector<char> packed;  // blocks; empty when all are

  Parameters(const Index& index, const T* centers, const T* raw, const T* weights, Scaling scaling,
             bool all);

  // Packs the blocks of the listed ranks where that has not been done.
  void need(const std::vector<int32_t>& ranks, int64_t size);

 private:
  void pack(int64_t block);
  void pack_position(const T* center, int64_t rank);
  void pack_shapes(int64_t first, int members);
};

}  // namespace lardhm
