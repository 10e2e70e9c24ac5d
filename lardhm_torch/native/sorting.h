// Boxes of points, and sorting along a Z curve over a box.

#pragma once

#include <cstdint>
#include <limits>
#include <vector>

namespace lardhm {

template <class T, int D>
struct Box {
  T low[D], high[D];

  Box() {
    for (int d = 0; d < D; ++d) {
      low[d] = std::numeric_limits<T>::infinity();
      high[d] = -low[d];
    }
  }

  // Adds the finite coordinates of every `step`-th of the rows begin .. end; false if some of them are
  // not finite.
  bool add(const T* points, int64_t begin, int64_t end, int64_t step);
};

template <class T>
bool is_finite(const T* x, int n) {
  T sum = 0;
  for (int d = 0; d < n; ++d) sum += x[d] * T(0);
  return sum == T(0);
}

// Sorts numbered items by key: an item is its key and, in the low half, its number.
struct Sorter {
  std::vector<uint64_t> items, other;
  std::vector<uint32_t> histogram;

  void sort(int key_bits);

 private:
  void counting_pass(int shift, int bits);
};

// Z curve: how the bits of the cells along the axes interleave, coarse cells first.
template <int D>
struct ZCurve {
  float scale;  // cells a meter
  int32_t last[D];
  int bits = 0;
  std::vector<uint32_t> spread[D];

  // About `cells` cubes over a box with these edges, at most 2^10 along an axis.
  ZCurve(const double* edges, double cells);

  // Fills sorter.items with n points, those of neighboring cells after each other.
  template <class T>
  void sort(const T* points, const T* low, int64_t n, Sorter& sorter) const;

 private:
  void assign_bit(int d, int level);

  template <class T>
  void make_items(const T* points, const T* low, int64_t first, int n, uint64_t* items) const;
};

}  // namespace lardhm
