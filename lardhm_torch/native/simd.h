// Vectors: one register of the widest available kind, and its exp and sigmoid.

#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

#define LARDHM_INLINE inline __attribute__((always_inline))

namespace lardhm {

#if defined(__AVX512F__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#define LARDHM_AVX512 1
constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif

template <class T, int Bytes>
struct Vectors;

template <int Bytes>
struct Vectors<float, Bytes> {
  typedef float V __attribute__((vector_size(Bytes)));
  typedef int32_t I __attribute__((vector_size(Bytes)));
  typedef uint32_t U __attribute__((vector_size(Bytes)));
  using Int = int32_t;
};

template <int Bytes>
struct Vectors<double, Bytes> {
  typedef double V __attribute__((vector_size(Bytes)));
  typedef int64_t I __attribute__((vector_size(Bytes)));
  typedef uint64_t U __attribute__((vector_size(Bytes)));
  using Int = int64_t;
};

template <class T>
struct Simd : Vectors<T, kRegisterBytes> {
  static constexpr int W = kRegisterBytes / sizeof(T);
};

template <class I>
inline I vmin(I a, I b) {
  return a < b ? a : b;
}

template <class I>
inline I vmax(I a, I b) {
  return a > b ? a : b;
}

template <class V>
inline V load(const void* from) {
  V v;
  std::memcpy(&v, from, sizeof(V));
  return v;
}

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

// One bit a lane, set where a <= b; lanes are integers of 4 or 8 bytes.
template <class I>
inline uint32_t bits_le(I a, I b) {
  constexpr int lanes = sizeof(I) / sizeof(a[0]);
#if defined(LARDHM_AVX512)
  if constexpr (sizeof(I) == 64 && lanes == 16)
    return _mm512_cmple_epi32_mask((__m512i)a, (__m512i)b);
  if constexpr (sizeof(I) == 64 && lanes == 8)
    return _mm512_cmple_epi64_mask((__m512i)a, (__m512i)b);
#endif
#if defined(__AVX2__)
  if constexpr (sizeof(I) == 32 && lanes == 8)
    return _mm256_movemask_ps((__m256)(a <= b));
  if constexpr (sizeof(I) == 32 && lanes == 4)
    return _mm256_movemask_pd((__m256d)(a <= b));
#endif
#if defined(__SSE2__)
  if constexpr (sizeof(I) == 16 && lanes == 4) return _mm_movemask_ps((__m128)(a <= b));
  if constexpr (sizeof(I) == 16 && lanes == 2) return _mm_movemask_pd((__m128d)(a <= b));
#endif
  uint32_t bits = 0;
  for (int lane = 0; lane < lanes; ++lane) bits |= uint32_t(a[lane] <= b[lane]) << lane;
  return bits;
}

// One bit a lane, set where the lane of a comparison's result is.
template <class T>
inline uint32_t bits_of(typename Simd<T>::I mask) {
  return bits_le<typename Simd<T>::I>(mask, typename Simd<T>::I{} - 1);
}

// All bits of a lane set where the lane's bit is.
template <class T>
inline typename Simd<T>::I mask_of(uint32_t bits) {
  using I = typename Simd<T>::I;
  I lane_bit;
  for (int lane = 0; lane < Simd<T>::W; ++lane) lane_bit[lane] = typename Simd<T>::Int(1) << lane;
  return (lane_bit & typename Simd<T>::Int(bits)) != 0;
}

// Combines the lanes of a register, half with half.
template <class T, int Bytes, class Combine>
inline T fold_lanes(typename Vectors<T, Bytes>::V v, const Combine& combine) {
  if constexpr (Bytes > 16) {
    typename Vectors<T, Bytes / 2>::V half[2];
    std::memcpy(half, &v, Bytes);
    return fold_lanes<T, Bytes / 2>(combine(half[0], half[1]), combine);
  } else if constexpr (sizeof(T) == 8) {
    return combine(v[0], v[1]);
  } else {
    return combine(combine(v[0], v[1]), combine(v[2], v[3]));
  }
}

template <class T>
inline T smallest_lane(typename Simd<T>::V v) {
  return fold_lanes<T, kRegisterBytes>(v, [](auto a, auto b) { return a < b ? a : b; });
}

template <class T>
inline T sum_lanes(typename Simd<T>::V v) {
  return fold_lanes<T, kRegisterBytes>(v, [](auto a, auto b) { return a + b; });
}

// Lanes of a (0 .. W - 1) and b (W .. 2 W - 1), picked by number.
template <class T>
inline typename Simd<T>::V shuffle(typename Simd<T>::V a, typename Simd<T>::V b,
                                   typename Simd<T>::I lanes) {
#if defined(__GNUC__) && !defined(__clang__)
  return __builtin_shuffle(a, b, lanes);
#else
  typename Simd<T>::V picked;
  for (int i = 0; i < Simd<T>::W; ++i)
    picked[i] = lanes[i] < Simd<T>::W ? a[lanes[i]] : b[lanes[i] - Simd<T>::W];
  return picked;
#endif
}

// Lane i of register j becomes lane j of register i, for W registers: in each stage, blocks of 1, 2, 4, ...
// lanes change places.
template <class T, int Stage = 1>
inline void transpose(typename Simd<T>::V* v) {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  constexpr int W = Simd<T>::W;
  if constexpr (Stage < W) {
    I first, second;
    for (int lane = 0; lane < W; ++lane) {
      first[lane] = lane & Stage ? W + lane - Stage : lane;
      second[lane] = lane & Stage ? W + lane : lane + Stage;
    }
    for (int i = 0; i < W; ++i) {
      if (i & Stage) continue;
      const V a = v[i], b = v[i + Stage];
      v[i] = shuffle<T>(a, b, first);
      v[i + Stage] = shuffle<T>(a, b, second);
    }
    transpose<T, 2 * Stage>(v);
  }
}

template <class T>
struct ExpConstants;

template <>
struct ExpConstants<float> {
  static constexpr float lowest = -87.0f, highest = 88.0f, shifter = 12582912.0f;  // 1.5 * 2^23
  static constexpr float ln2_high = 0.693359375f, ln2_low = -2.12194440e-4f;
  static constexpr int mantissa = 23, terms = 7;
};

template <>
struct ExpConstants<double> {
  static constexpr double lowest = -708.0, highest = 709.0, shifter = 6755399441055744.0;  // 1.5 * 2^52
  static constexpr double ln2_high = 0.693147180369123816490, ln2_low = 1.90821492927058770002e-10;
  static constexpr int mantissa = 52, terms = 13;
};

// exp(x) for x <= `highest`: 2^n times the Taylor series of the rest, |rest| <= ln(2) / 2; 0 below
// `lowest`.
template <class T>
LARDHM_INLINE typename Simd<T>::V exp_of(typename Simd<T>::V x) {
  using V = typename Simd<T>::V;
  using U = typename Simd<T>::U;  // may overflow, where the result is 0
  using C = ExpConstants<T>;
  const V shifted = x * T(1.4426950408889634) + C::shifter;
  const V n = shifted - C::shifter;
  const V rest = (x - n * C::ln2_high) - n * C::ln2_low;
  T factorial = 1;
  for (int i = 2; i <= C::terms; ++i) factorial *= i;
  V y = 1 / factorial - V{};
#pragma GCC unroll 16
  for (int i = C::terms; i > 0; --i) {
    factorial /= i;  // exact: a factorial again
    y = y * rest + 1 / factorial;
  }
  const V scaled = (V)((U)y + ((U)shifted << C::mantissa));
  return x < C::lowest ? V{} : scaled;
}

template <class T>
inline typename Simd<T>::V sigmoid(typename Simd<T>::V x) {
  using V = typename Simd<T>::V;
  const V e = exp_of<T>(x < 0 ? x : -x);
  const V near_one = T(1) / (T(1) + e);
  return x < 0 ? e * near_one : near_one;
}

}  // namespace lardhm
