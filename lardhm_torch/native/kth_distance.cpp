// The inner loop of the search: distances to a list of centers and the k-th smallest of them.

#include <limits>
#include <type_traits>
#include <vector>

#include "packets.h"

namespace lardhm {

// The k smallest of what is inserted, lane by lane, as bits of non-negative floats.
template <class I, int K>
struct Smallest {
  I value[K > 0 ? K : 1];
  std::vector<I> more;
  int k;

  explicit Smallest(int k_) : k(K > 0 ? K : k_) {
    I most = std::numeric_limits<std::decay_t<decltype(I{}[0])>>::max() - I{};
    if constexpr (K > 0) {
      for (int j = 0; j < K; ++j) value[j] = most;
    } else {
      more.assign(k, most);
    }
  }

  inline void insert(I x) {
    if constexpr (K > 0) {
#pragma GCC unroll 16
      for (int j = 0; j < K - 1; ++j) {
        const I low = vmin(value[j], x);
        x = vmax(value[j], x);
        value[j] = low;
      }
      value[K - 1] = vmin(value[K - 1], x);
    } else {
      for (int j = 0; j < k; ++j) {
        const I low = vmin(more[j], x);
        x = vmax(more[j], x);
        more[j] = low;
      }
    }
  }

  I last() const {
    if constexpr (K > 0) return value[K - 1];
    return more[k - 1];
  }
};

// A product that is rounded before it is added to anything.
template <class V>
inline V rounded(V product) {
#if defined(__x86_64__)
  asm("" : "+v"(product));
#elif defined(__aarch64__)
  asm("" : "+w"(product));
#else
  asm("" : "+m"(product));
#endif
  return product;
}

// Squared distances of the packet to the listed centers (as bits, in `distance`); their k-th
// smallest, lane by lane. Every step is rounded as in the definition, so that ties are the same.
template <class T, int D, int K>
typename Simd<T>::I kth_distance(const Packet<T, D>& packet, const T* positions,
                                 const int32_t* list, int64_t n, int k,
                                 typename Simd<T>::I* distance) {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  Smallest<I, K> smallest(k);
  for (int64_t i = 0; i < n; ++i) {
    const T* center = positions + int64_t(list[i]) * Layout<D>::position;
    V squared = {};
    for (int d = 0; d < D; ++d) {
      const V offset = packet.x[d] - center[d];
      squared = d == 0 ? rounded(offset * offset) : squared + rounded(offset * offset);
    }
    distance[i] = (I)squared;
    smallest.insert((I)squared);
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
