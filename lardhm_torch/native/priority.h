// Random order of points that depends on their coordinates alone, as `thinning.priorities`.

#pragma once

#include <cstdint>
#include <cstring>

namespace lardhm {

constexpr uint32_t kMultipliers[3] = {0x9E3779B1u, 0x85EBCA77u, 0xC2B2AE3Du};
constexpr uint32_t kCellPriorities = 0x27D4EB2Fu;  // as thinning.CELLS

// Hash of the coordinates in float32, below 2^31.
template <class T, int D>
uint32_t priority(const T* point, uint32_t mixed = 0) {
  for (int d = 0; d < D; ++d) {
    const float value = float(point[d]);
    uint32_t word;
    std::memcpy(&word, &value, sizeof(word));
    mixed = (mixed ^ word) * kMultipliers[d % 3];
    mixed ^= mixed >> 15;
  }
  return (mixed * kMultipliers[1]) >> 1;
}

}  // namespace lardhm
