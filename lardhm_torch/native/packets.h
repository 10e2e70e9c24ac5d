// Packets: neighboring points, one a lane of a register, and what they select.

#pragma once

#include <cstdint>
#include <vector>

#include "parameters.h"

namespace lardhm {

template <class T, int D>
struct Packet {
  typename Simd<T>::V x[D];
  typename Simd<T>::V farthest;  // squared distance of the k-th center [m^2], once it is known
  typename Simd<T>::V fading;    // its inverse [m^-2]; 0 where neighbors do not fade
  int64_t begin;
  const int32_t* order;
  int lanes;
  int64_t row(int lane) const { return begin + order[lane]; }
};

// The clusters some lane of a packet selected; bits tell which lanes.
struct Selection {
  std::vector<int32_t> rank;
  std::vector<uint32_t> bits;
  int64_t size = 0;
};

// Squared distances of the packet to the listed centers (as bits, in `distance`) -> their k-th
// smallest, lane by lane.
template <class T, int D>
using KthFn = typename Simd<T>::I (*)(const Packet<T, D>&, const T*, const int32_t*, int64_t, int,
                                      typename Simd<T>::I*);

// The function for k neighbors, specialized for each usual k.
template <class T, int D>
KthFn<T, D> kth_distance_for(int k);

}  // namespace lardhm
