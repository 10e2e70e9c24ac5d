// Candidates: centers that can be among the k nearest of some point of a box.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "index.h"
#include "simd.h"
#include "sorting.h"

namespace lardhm {

constexpr int kWide = Simd<float>::W;
using Wide = Simd<float>::V;
using WideInt = Simd<float>::I;

// Box of points, relative to the corner of the centers' box, grown by the rounding error.
template <int D>
struct Region {
  float middle[D] = {}, half[D] = {};

  Region() = default;

  template <class T>
  Region(const Box<T, D>& box, const T* origin, float reach) {
    float low[D], high[D], largest = reach;
    for (int d = 0; d < D; ++d) {
      low[d] = float(box.low[d] - origin[d]);
      high[d] = float(box.high[d] - origin[d]);
      largest = std::max(largest, std::max(std::abs(low[d]), std::abs(high[d])));
    }
    const bool countable = largest < 1e18f;  // squares of distances are finite; else keep all
    for (int d = 0; d < D; ++d) {
      middle[d] = countable ? 0.5f * (low[d] + high[d]) : 0.0f;
      half[d] = countable ? 0.5f * (high[d] - low[d]) + largest * 5e-7f
                          : std::numeric_limits<float>::infinity();
    }
  }
};

#if defined(__AVX2__) && !defined(LARDHM_AVX512)
// For each set of 8 lanes the lanes in it, ascending, one a byte.
struct LaneLists {
  uint64_t of[256] = {};
  constexpr LaneLists() {
    for (int bits = 0; bits < 256; ++bits)
      for (int lane = 0, n = 0; lane < 8; ++lane)
        if (bits >> lane & 1) of[bits] |= uint64_t(lane) << 8 * n++;
  }
};
inline constexpr LaneLists kLanes;
#endif

// Moves the lanes of `bits` to the front; writes a whole register.
template <class X>
inline void compress(uint32_t bits, const X* from, X* to) {
#if defined(LARDHM_AVX512)
  _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(uint16_t(bits), _mm512_loadu_si512(from)));
#elif defined(__AVX2__)
  const __m256i lanes = _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(int64_t(kLanes.of[bits & 255])));
  _mm256_storeu_si256((__m256i*)to,
                      _mm256_permutevar8x32_epi32(_mm256_loadu_si256((const __m256i*)from), lanes));
#else
  for (int64_t n = 0, lane = 0; lane < kWide; ++lane) {
    to[n] = from[lane];
    n += (bits >> lane) & 1;
  }
#endif
}

inline Wide at_least_zero(Wide x) { return (Wide)vmax((WideInt)x, WideInt{}); }

inline WideInt squared_as_bits(float x) {
  const Wide squared = x * x - Wide{};
  return (WideInt)squared;
}

// Lanes of one register whose boxes are within the radius (squared, as bits) of the region.
template <int D>
inline uint32_t boxes_within(const Region<D>& region, const float* const* low,
                             const float* const* high, WideInt limit) {
  Wide near2 = {};
  for (int d = 0; d < D; ++d) {
    const Wide below = load<Wide>(low[d]) - (region.middle[d] + region.half[d]);
    const Wide above = (region.middle[d] - region.half[d]) - load<Wide>(high[d]);
    const Wide outside = at_least_zero(below > above ? below : above);
    near2 += outside * outside;
  }
  return bits_le<WideInt>((WideInt)near2, limit);
}

// The same for single centers.
template <int D>
inline uint32_t centers_within(const Region<D>& region, const float* const* at, WideInt limit) {
  Wide near2 = {};
  for (int d = 0; d < D; ++d) {
    const Wide offset = load<Wide>(at[d]) - region.middle[d];
    const Wide outside = at_least_zero((Wide)((WideInt)offset & 0x7fffffff) - region.half[d]);
    near2 += outside * outside;
  }
  return bits_le<WideInt>((WideInt)near2, limit);
}

// The lanes first .. first + kWide that exist among `count`.
inline uint32_t existing(int64_t first, int64_t count) {
  if (first >= count) return 0;
  return ~0u >> (32 - int(std::min<int64_t>(kWide, count - first)));
}

struct Numbers {
  int32_t lane[kWide];
  explicit Numbers(int64_t first) {
    for (int i = 0; i < kWide; ++i) lane[i] = int32_t(first) + i;
  }
};

// Blocks of neighboring centers, their boxes axis by axis.
template <int D>
struct Blocks {
  std::vector<int32_t> block;
  std::vector<float> low[D], high[D];
  int64_t size = 0;

  // The blocks of the index within the radius of the region.
  void collect(const Index& index, const Region<D>& region, float radius) {
    block.resize(index.blocks + kWide);
    for (int d = 0; d < D; ++d) {
      low[d].resize(index.blocks + kWide);
      high[d].resize(index.blocks + kWide);
    }
    const WideInt limit = squared_as_bits(radius * 1.0001f);
    size = 0;
    for (int64_t i = 0; i < index.tiles; i += kWide) {
      const float *low_at[D], *high_at[D];
      corners(index.tile_boxes, i, low_at, high_at);
      uint32_t keep = boxes_within(region, low_at, high_at, limit) & existing(i, index.tiles);
      for (; keep; keep &= keep - 1) {
        const int64_t first = (i + __builtin_ctz(keep)) * kBlock;
        for (int64_t lane = 0; lane < kBlock; lane += kWide)
          add(index, first + lane, region, limit);
      }
    }
  }

  static void corners(const float* boxes, int64_t i, const float** low_at, const float** high_at) {
    for (int d = 0; d < D; ++d) {
      low_at[d] = boxes + i / kBlock * kBlock * D * 2 + d * kBlock + i % kBlock;
      high_at[d] = low_at[d] + D * kBlock;
    }
  }

  void add(const Index& index, int64_t i, const Region<D>& region, WideInt limit) {
    const float *low_at[D], *high_at[D];
    corners(index.boxes, i, low_at, high_at);
    const uint32_t keep = boxes_within(region, low_at, high_at, limit) & existing(i, index.blocks);
    if (!keep) return;
    compress(keep, Numbers(i).lane, block.data() + size);
    for (int d = 0; d < D; ++d) compress(keep, low_at[d], low[d].data() + size);
    for (int d = 0; d < D; ++d) compress(keep, high_at[d], high[d].data() + size);
    size += __builtin_popcount(keep);
  }

  uint32_t within(int64_t i, const Region<D>& region, WideInt limit) const {
    const float *low_at[D], *high_at[D];
    for (int d = 0; d < D; ++d) {
      low_at[d] = low[d].data() + i;
      high_at[d] = high[d].data() + i;
    }
    return boxes_within(region, low_at, high_at, limit) & existing(i, size);
  }
};

// Centers by rank, ascending, and their coordinates relative to the corner of the centers' box.
template <int D>
struct Candidates {
  std::vector<int32_t> rank;
  std::vector<float> at[D];
  int64_t size = 0;

  void reserve(int64_t n) {
    if (int64_t(rank.size()) >= n + kWide) return;
    rank.resize(2 * n + kWide);
    for (int d = 0; d < D; ++d) at[d].resize(2 * n + kWide);
  }

  // Members of the blocks within the radius of the region.
  void collect(const Index& index, const Blocks<D>& blocks, const Region<D>& region,
               float radius) {
    const WideInt limit = squared_as_bits(radius * 1.0001f);
    size = 0;
    for (int64_t i = 0; i < blocks.size; i += kWide)
      for (uint32_t keep = blocks.within(i, region, limit); keep; keep &= keep - 1) {
        reserve(size + kBlock);
        const int64_t block = blocks.block[i + __builtin_ctz(keep)];
        for (int lane = 0; lane < kBlock; lane += kWide)
          add(index, block, lane, region, limit);
      }
  }

  void add(const Index& index, int64_t block, int lane, const Region<D>& region, WideInt limit) {
    const float* from[D];
    for (int d = 0; d < D; ++d) from[d] = index.relative + (block * D + d) * kBlock + lane;
    const int64_t first = block * kBlock + lane;
    const uint32_t keep =
        centers_within(region, from, limit) & existing(first, index.header.count);
    if (!keep) return;
    compress(keep, Numbers(first).lane, rank.data() + size);
    for (int d = 0; d < D; ++d) compress(keep, from[d], at[d].data() + size);
    size += __builtin_popcount(keep);
  }

  // Ranks of those within the radius of the region; returns how many.
  int64_t pick(const Region<D>& region, float radius, int32_t* to) const {
    const WideInt limit = squared_as_bits(radius);
    int64_t kept = 0;
    for (int64_t i = 0; i < size; i += kWide) {
      const float* from[D];
      for (int d = 0; d < D; ++d) from[d] = at[d].data() + i;
      const uint32_t keep = centers_within(region, from, limit) & existing(i, size);
      compress(keep, rank.data() + i, to + kept);
      kept += __builtin_popcount(keep);
    }
    return kept;
  }
};

}  // namespace lardhm
