// Boxes and sorting, compiled once.

#include "sorting.h"

#include <algorithm>
#include <cmath>
#include <cstring>

#include "simd.h"

namespace lardhm {
namespace {

constexpr int kRun = 16;    // rows added to a box at a time
constexpr int kKeyed = 128;  // rows keyed at a time: stores reach the cache before the loads

// Widens the bounds by the finite numbers of one run; sums what is not finite.
template <int Run, class T>
void add_run(const T* run, T* lowest, T* highest, T* sum) {
  const T largest = std::numeric_limits<T>::max();
  for (int i = 0; i < Run; ++i) {
    const T x = run[i];
    sum[i] += x * T(0);
    lowest[i] = x < lowest[i] && x >= -largest ? x : lowest[i];
    highest[i] = x > highest[i] && x <= largest ? x : highest[i];
  }
}

}  // namespace

template <class T, int D>
bool Box<T, D>::add(const T* points, int64_t begin, int64_t end, int64_t step) {
  constexpr int kNumbers = kRun * D;
  T lowest[kNumbers], highest[kNumbers], sum[kNumbers] = {};
  for (int i = 0; i < kNumbers; ++i) lowest[i] = low[i % D], highest[i] = high[i % D];
  for (int64_t row = begin; row < end; row += kRun * step) {
    const T* run = points + row * D;
    if (step > 1 || row + kRun > end) {
      for (int64_t one = row; one < std::min(end, row + kRun * step); one += step)
        add_run<D>(points + one * D, lowest, highest, sum);
    } else {
      add_run<kNumbers>(run, lowest, highest, sum);
    }
  }
  T total = 0;
  for (int i = 0; i < kNumbers; ++i) {
    low[i % D] = std::min(low[i % D], lowest[i]);
    high[i % D] = std::max(high[i % D], highest[i]);
    total += sum[i];
  }
  return total == T(0);
}

void Sorter::counting_pass(int shift, int bits) {
  const uint32_t mask = (1u << bits) - 1;
  histogram.assign(int64_t(mask) + 2, 0);
  for (uint64_t item : items) ++histogram[((item >> shift) & mask) + 1];
  for (uint32_t digit = 0; digit < mask; ++digit) histogram[digit + 1] += histogram[digit];
  other.resize(items.size());
  for (uint64_t item : items) other[histogram[(item >> shift) & mask]++] = item;
  items.swap(other);
}

void Sorter::sort(int key_bits) {
  const int passes = key_bits <= 15 ? 1 : (key_bits + 11) / 12;
  for (int pass = 0; pass < passes; ++pass) {
    const int shift = key_bits * pass / passes;
    counting_pass(32 + shift, key_bits * (pass + 1) / passes - shift);
  }
}

template <int D>
ZCurve<D>::ZCurve(const double* given, double cells) {
  double edges[D], largest = 0, volume = 1, shortest = 0;
  for (int d = 0; d < D; ++d) edges[d] = std::max(0.0, given[d]);  // -inf: nothing is finite
  for (int d = 0; d < D; ++d) largest = std::max(largest, edges[d]);
  shortest = largest / 1024;
  for (int d = 0; d < D; ++d) volume *= std::max(edges[d], shortest);
  const double edge = std::max(std::pow(volume / cells, 1.0 / D), shortest);
  const bool usable = edge > 0 && std::isfinite(edge) && std::isfinite(1 / edge);
  scale = usable ? float(1 / edge) : 0.0f;
  int axis_bits[D];
  for (int d = 0; d < D; ++d) {
    last[d] = usable ? std::min(int32_t(edges[d] / edge), 1023) : 0;
    for (axis_bits[d] = 0; (last[d] >> axis_bits[d]) != 0;) ++axis_bits[d];
    spread[d].assign(last[d] + 1, 0);
  }
  for (int level = 0; level < 10; ++level)
    for (int d = D - 1; d >= 0; --d)
      if (level < axis_bits[d]) assign_bit(d, level);
}

template <int D>
void ZCurve<D>::assign_bit(int d, int level) {
  for (int32_t cell = 0; cell <= last[d]; ++cell)
    spread[d][cell] |= uint32_t((cell >> level) & 1) << bits;
  ++bits;
}

// Cells along one axis of numbers in units of a cell: from 0, NaN too, up to the last.
static void clamp_to_cells(const float* at, float last, int32_t* cell) {
  using V = Simd<float>::V;
  for (int j = 0; j < kKeyed; j += Simd<float>::W) {
    V x = load<V>(at + j);
    x = x > 0 ? x : V{};
    const auto whole = __builtin_convertvector(x < last ? x : last - V{}, Simd<float>::I);
    std::memcpy(cell + j, &whole, sizeof(whole));
  }
}

// Items for the n <= kKeyed rows from `first` on, keyed by their cells.
template <int D>
template <class T>
void ZCurve<D>::make_items(const T* points, const T* low, int64_t first, int n,
                           uint64_t* items) const {
  alignas(64) float at[D][kKeyed] = {};
  alignas(64) int32_t cell[D][kKeyed];
  const T* from = points + first * D;
  for (int j = 0; j < n; ++j)
    for (int d = 0; d < D; ++d) at[d][j] = float(from[j * D + d] - low[d]) * scale;
  for (int d = 0; d < D; ++d) clamp_to_cells(at[d], float(last[d]), cell[d]);
  for (int j = 0; j < n; ++j) {
    uint32_t key = 0;
    for (int d = 0; d < D; ++d) key |= spread[d][cell[d][j]];
    items[j] = uint64_t(key) << 32 | uint64_t(first + j);
  }
}

template <int D>
template <class T>
void ZCurve<D>::sort(const T* points, const T* low, int64_t n, Sorter& sorter) const {
  sorter.items.resize(n);
  for (int64_t i = 0; i < n; i += kKeyed)
    make_items(points, low, i, int(std::min<int64_t>(kKeyed, n - i)), sorter.items.data() + i);
  sorter.sort(bits);
}

template struct Box<float, 2>;
template struct Box<float, 3>;
template struct Box<double, 2>;
template struct Box<double, 3>;
template struct ZCurve<2>;
template struct ZCurve<3>;
template void ZCurve<2>::sort(const float*, const float*, int64_t, Sorter&) const;
template void ZCurve<3>::sort(const float*, const float*, int64_t, Sorter&) const;
template void ZCurve<2>::sort(const double*, const double*, int64_t, Sorter&) const;
template void ZCurve<3>::sort(const double*, const double*, int64_t, Sorter&) const;

}  // namespace lardhm
