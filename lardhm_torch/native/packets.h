// Packets: neighboring points, one a lane of a register, and what they select.

#pragma once

#include <cstdint>
#include <vector>

#include "parameters.h"

namespace lardhm {

constexpr int kBeyond = 16;  // after a list of centers: none of them, infinitely far

template <class T, int D>
struct Packet {
  typename Simd<T>::V x[D];
  typename Simd<T>::V farthest;  // squared distance of the k-th center [m^2], once it is known
  typename Simd<T>::V fading;    // its inverse [m^-2]; 0 where neighbors do not fade
  bool all_fade = false;         // by how far they are: the bits are left out
  const typename Simd<T>::V* squared;  // in that case, distances of the selected [m^2]
  int64_t begin;
  const int32_t* order;
  int lanes;
  int64_t row(int lane) const { return begin + order[lane]; }
};

// From a center, every step rounded as in the definition, so that ties are the same [m^2].
template <class T, int D>
LARDHM_INLINE typename Simd<T>::V squared_distance(
    const Packet<T, D>& packet, const T* center) {
  typename Simd<T>::V squared = {};
  for (int d = 0; d < D; ++d) {
    const typename Simd<T>::V offset = packet.x[d] - center[d];
    squared = d == 0 ? rounded(offset * offset) : squared + rounded(offset * offset);
  }
  return squared;
}

// The clusters some lane of a packet selected; bits tell which lanes, unless `all_fade`.
struct Selection {
  std::vector<int32_t> rank;
  std::vector<uint32_t> bits;
  int64_t size = 0;
};

// Squared distances of the packet to the listed centers (as bits, in `distance`) -> their k-th
// smallest, lane by lane. The list goes on with kBeyond others that are farther.
template <class T, int D>
using KthFn = typename Simd<T>::I (*)(const Packet<T, D>&, const T*, const int32_t*, int64_t, int,
                                      typename Simd<T>::I*);

// The function for k neighbors, specialized for each usual k.
template <class T, int D>
KthFn<T, D> kth_distance_for(int k);

}  // namespace lardhm
