// The inner loop of the search: distances to a list of centers and the k-th smallest of them.

#include <limits>
#include <type_traits>
#include <vector>

#include "packets.h"

namespace lardhm {

// Two values in order.
template <class I>
inline void exchange(I& a, I& b) {
  const I low = vmin(a, b);
  b = vmax(a, b);
  a = low;
}

// A bitonic run of values, ascending.
template <int N, class I>
LARDHM_INLINE void merge_bitonic(I* value) {
  if constexpr (N > 1) {
    for (int i = 0; i < N / 2; ++i) exchange(value[i], value[i + N / 2]);
    merge_bitonic<N / 2>(value);
    merge_bitonic<N / 2>(value + N / 2);
  }
}

// Eight values, ascending, by the fewest exchanges.
template <class I>
LARDHM_INLINE void sort_eight(I* value) {
  constexpr int kPairs[19][2] = {{0, 2}, {1, 3}, {4, 6}, {5, 7}, {0, 4}, {1, 5}, {2, 6},
                                 {3, 7}, {0, 1}, {2, 3}, {4, 5}, {6, 7}, {2, 4}, {3, 5},
                                 {1, 4}, {3, 6}, {1, 2}, {3, 4}, {5, 6}};
#pragma GCC unroll 19
  for (const auto& pair : kPairs) exchange(value[pair[0]], value[pair[1]]);
}

template <class I>
inline I largest_value() {
  return std::numeric_limits<std::decay_t<decltype(I{}[0])>>::max() - I{};
}

// The k-th smallest of the distances that `next` gives, n >= k of them, lane by lane, as bits of
// non-negative floats. For a small k one after the other finds its place among the smallest, ...
template <class I, int K, class Next>
inline I kth_of(int64_t n, const Next& next) {
  I value[K];
  for (I& v : value) v = largest_value<I>();
  for (int64_t i = 0; i < n; ++i) {
    I given = next(i);
#pragma GCC unroll 16
    for (int j = 0; j < K; ++j) exchange(value[j], given);
  }
  return value[K - 1];
}

// ... for any k the same, unless it is one of the usual ones, ...
template <class I, class Next>
inline I kth_of_any(int64_t n, int k, const Next& next) {
  std::vector<I> value(k, largest_value<I>());
  for (int64_t i = 0; i < n; ++i) {
    I given = next(i);
    for (I& v : value) exchange(v, given);
  }
  return value.back();
}

// ... for a larger k eight together: sorted, then merged into the 8 or 16 smallest. Of the last
// eight only the largest that stays matters.
template <class I, int K, class Next>
LARDHM_INLINE I kth_of_eights(int64_t n, const Next& next) {
  constexpr int kKept = K > 8 ? 16 : 8;
  static_assert(K <= kKept);
  I value[kKept], given[8];
  const auto sorted_eight = [&](int64_t i, I* to) __attribute__((always_inline)) {
    for (int j = 0; j < 8; ++j) to[j] = next(i + j);
    sort_eight(to);
  };
  sorted_eight(0, value);
  if constexpr (kKept == 16) {
    sorted_eight(8, value + 8);
    for (int i = 0; i < 8; ++i) exchange(value[i], value[15 - i]);
    merge_bitonic<8>(value);
    merge_bitonic<8>(value + 8);
  }
  I* upper = value + kKept - 8;
  for (int64_t i = kKept; i < n; i += 8) {
    sorted_eight(i, given);
    for (int j = 0; j < 8; ++j) upper[j] = vmin(upper[j], given[7 - j]);
    if (K == kKept && i + 8 >= n) {
      I largest = value[0];
#pragma GCC unroll 16
      for (int j = 1; j < kKept; ++j) largest = vmax(largest, value[j]);
      return largest;
    }
    merge_bitonic<kKept>(value);
  }
  return value[K - 1];
}

// Squared distances of the packet to the listed centers (as bits, in `distance`); their k-th
// smallest, lane by lane.
template <class T, int D, int K>
typename Simd<T>::I kth_distance(const Packet<T, D>& packet, const T* positions,
                                 const int32_t* list, int64_t n, int k,
                                 typename Simd<T>::I* distance) {
  using I = typename Simd<T>::I;
  const auto next = [&](int64_t i) __attribute__((always_inline)) {
    const T* center = positions + int64_t(list[i]) * Layout<D>::position;
    return distance[i] = (I)squared_distance<T, D>(packet, center);
  };
  if constexpr (K == 0)
    return kth_of_any<I>(n, k, next);
  else if constexpr (K < 8)
    return kth_of<I, K>(n, next);
  else
    return kth_of_eights<I, K>(n, next);
}

// One function for each usual k, chosen once a call.
#define LARDHM_FOR_K(k, USE) \
  switch (k) {               \
    case 1: USE(1);          \
    case 2: USE(2);          \
    case 3: USE(3);          \
    case 4: USE(4);          \
    case 5: USE(5);          \
    case 6: USE(6);          \
    case 8: USE(8);          \
    case 10: USE(10);        \
    case 12: USE(12);        \
    case 16: USE(16);        \
    default: USE(0);         \
  }

template <class T, int D>
KthFn<T, D> kth_distance_for(int k) {
#define LARDHM_USE(K) return &kth_distance<T, D, K>
  LARDHM_FOR_K(k, LARDHM_USE)
#undef LARDHM_USE
}

template KthFn<float, 2> kth_distance_for<float, 2>(int);
template KthFn<float, 3> kth_distance_for<float, 3>(int);
template KthFn<double, 2> kth_distance_for<double, 2>(int);
template KthFn<double, 3> kth_distance_for<double, 3>(int);

}  // namespace lardhm
