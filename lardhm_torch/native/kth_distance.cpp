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
inline __attribute__((always_inline)) void merge_bitonic(I* value) {
  if constexpr (N > 1) {
    for (int i = 0; i < N / 2; ++i) exchange(value[i], value[i + N / 2]);
    merge_bitonic<N / 2>(value);
    merge_bitonic<N / 2>(value + N / 2);
  }
}

// Any values, ascending.
template <int N, class I>
inline __attribute__((always_inline)) void sort_values(I* value) {
  if constexpr (N > 1) {
    sort_values<N / 2>(value);
    sort_values<N / 2>(value + N / 2);
    for (int i = 0; i < N / 2; ++i) exchange(value[i], value[N - 1 - i]);
    merge_bitonic<N / 2>(value);
    merge_bitonic<N / 2>(value + N / 2);
  }
}

template <class I>
inline I largest_value() {
  return std::numeric_limits<std::decay_t<decltype(I{}[0])>>::max() - I{};
}

// The k smallest of what is inserted, lane by lane, as bits of non-negative floats: for a small k one
// value after the other, ...
template <class I, int K>
struct Smallest {
  static constexpr int kAtOnce = 1;
  I value[K];

  explicit Smallest(int) {
    for (I& v : value) v = largest_value<I>();
  }

  inline void insert(I* given) {
#pragma GCC unroll 16
    for (int j = 0; j < K; ++j) exchange(value[j], *given);
  }

  I last() const { return value[K - 1]; }
};

// ... for any k the same, unless it is one of the usual ones, ...
template <class I>
struct SmallestOfAny {
  static constexpr int kAtOnce = 1;
  std::vector<I> value;

  explicit SmallestOfAny(int k) : value(k, largest_value<I>()) {}

  inline void insert(I* given) {
    for (I& v : value) exchange(v, *given);
  }

  I last() const { return value.back(); }
};

// ... for a larger k eight together: sorted, then merged into those kept.
template <class I, int K>
struct SmallestOfEights {
  static constexpr int kAtOnce = 8, kKept = K > 8 ? 16 : 8;
  static_assert(K <= kKept);
  I value[kKept];

  explicit SmallestOfEights(int) {
    for (I& v : value) v = largest_value<I>();
  }

  inline __attribute__((always_inline)) void insert(I* given) {
    sort_values<kAtOnce>(given);
    I* upper = value + kKept - kAtOnce;
    for (int i = 0; i < kAtOnce; ++i) upper[i] = vmin(upper[i], given[kAtOnce - 1 - i]);
    merge_bitonic<kKept>(value);
  }

  I last() const { return value[K - 1]; }
};

template <class I, int K>
using KeptFor =
    std::conditional_t<K == 0, SmallestOfAny<I>,
                       std::conditional_t<(K < 8), Smallest<I, K>, SmallestOfEights<I, K>>>;

// Squared distances of the packet to the listed centers (as bits, in `distance`); their k-th
// smallest, lane by lane. Every step is rounded as in the definition, so that ties are the same.
template <class T, int D, int K>
typename Simd<T>::I kth_distance(const Packet<T, D>& packet, const T* positions,
                                 const int32_t* list, int64_t n, int k,
                                 typename Simd<T>::I* distance) {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  using Kept = KeptFor<I, K>;
  Kept smallest(k);
  const auto squared_distance = [&](int64_t i) {
    const T* center = positions + int64_t(list[i]) * Layout<D>::position;
    V squared = {};
    for (int d = 0; d < D; ++d) {
      const V offset = packet.x[d] - center[d];
      squared = d == 0 ? rounded(offset * offset) : squared + rounded(offset * offset);
    }
    return distance[i] = (I)squared;
  };
  constexpr int kAtOnce = Kept::kAtOnce;
  I together[kAtOnce];
  for (int64_t i = 0; i < n; i += kAtOnce) {
    for (int j = 0; j < kAtOnce; ++j)
      together[j] = i + j < n ? squared_distance(i + j) : largest_value<I>();
    smallest.insert(together);
  }
  return smallest.last();
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
