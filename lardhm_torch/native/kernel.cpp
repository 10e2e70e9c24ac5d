// LARD Hilbert map on the CPU: exact k nearest clusters, kernel and dot product in one pass.
//
//   log_odds(x) = sum over the k nearest centers c_m of w_m exp(-|inv(L_m) (x - c_m)|^2 / 2)
//
// Points are sorted along a Z curve over their box; each run of up to one register of neighboring
// points is a packet. Its candidates are the centers within a radius of the packet's box, found by
// filtering blocks of centers for a region of some thousand points, their members for a group of
// a hundred, and those for the packet. The radius is a guess from the packet before; if the k-th
// distance found turns out larger, the search is repeated with that distance, so the answer is
// exact anywhere in space. Pass 1 streams the candidates past the packet and keeps the k-th smallest
// distance; pass 2 evaluates the kernel of the few centers within it.
//
// The index is the centers in the order of a Z curve ("rank") with the boxes of every 16: cheap to
// build, and independent of k.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>
#include <tuple>
#include <vector>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// ---------------------------------------------------------------------------------------------
// Vectors: one register of the widest kind the compiler was told about.

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
  using Int = int32_t;
};

template <int Bytes>
struct Vectors<double, Bytes> {
  typedef double V __attribute__((vector_size(Bytes)));
  typedef int64_t I __attribute__((vector_size(Bytes)));
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

template <class T>
struct ExpConstants;

template <>
struct ExpConstants<float> {
  static constexpr float lowest = -87.0f, shifter = 12582912.0f;  // 1.5 * 2^23
  static constexpr float ln2_high = 0.693359375f, ln2_low = -2.12194440e-4f;
  static constexpr int mantissa = 23, terms = 7;
};

template <>
struct ExpConstants<double> {
  static constexpr double lowest = -708.0, shifter = 6755399441055744.0;  // 1.5 * 2^52
  static constexpr double ln2_high = 0.693147180369123816490, ln2_low = 1.90821492927058770002e-10;
  static constexpr int mantissa = 52, terms = 13;
};

// exp(x) for x <= 0: 2^n times the Taylor series of the rest, |rest| <= ln(2) / 2; 0 below `lowest`.
template <class T>
inline typename Simd<T>::V exp_negative(typename Simd<T>::V x) {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
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
  const V scaled = (V)((I)y + ((I)shifted << C::mantissa));
  return x < C::lowest ? V{} : scaled;
}

template <class T>
inline typename Simd<T>::V sigmoid(typename Simd<T>::V x) {
  using V = typename Simd<T>::V;
  const V e = exp_negative<T>(x < 0 ? x : -x);
  const V near_one = T(1) / (T(1) + e);
  return x < 0 ? e * near_one : near_one;
}

// ---------------------------------------------------------------------------------------------
// Threads: torch's pool; a forked child of a process that used it works alone (it would hang).

std::atomic<bool> forked{false};

void note_fork() { forked = true; }

const int fork_handler = pthread_atfork(nullptr, nullptr, note_fork);

int64_t num_threads() {
  return forked ? 1 : std::max<int64_t>(1, torch::stable::get_num_threads());
}

// work(task) for task = 0 .. tasks - 1, each once, on up to num_threads() threads.
template <class Work>
void run_tasks(int64_t tasks, const Work& work) {
  const int64_t workers = std::min(tasks, num_threads());
  if (workers <= 1) {
    for (int64_t task = 0; task < tasks; ++task) work(task);
    return;
  }
  std::atomic<int64_t> next{0};
  torch::stable::parallel_for(0, workers, 1, [&](int64_t begin, int64_t end) {
    for (int64_t worker = begin; worker < end; ++worker)
      for (int64_t task = next++; task < tasks; task = next++) work(task);
  });
}

// ---------------------------------------------------------------------------------------------
// Index: one block of bytes. Header, then the sections in the order of `Sections`.

constexpr uint64_t kMagic = 0x3278656d6864724cULL;
constexpr int kBlock = 16;        // centers in a block
constexpr float kFarAway = std::numeric_limits<float>::max();

struct Header {
  uint64_t magic, checksum;
  int64_t bytes, count;
  int32_t dim, item_size;
  double low[3], high[3];  // box of the centers [m]
};

uint64_t checksum(Header header) {
  header.checksum = 0;
  uint64_t words[sizeof(Header) / 8], hash = kMagic;
  static_assert(sizeof(Header) % 8 == 0, "the header is hashed in words");
  std::memcpy(words, &header, sizeof(header));
  for (uint64_t word : words) {
    hash = (hash ^ word) * 0xff51afd7ed558ccdULL;
    hash ^= hash >> 33;
  }
  return hash;
}

int64_t padded(int64_t count, int64_t to) { return (count + to - 1) / to * to; }

struct Sections {
  int64_t blocks, centers, order, relative, boxes, end;

  explicit Sections(const Header& h) {
    int64_t at = sizeof(Header);
    auto section = [&at](int64_t bytes) {
      const int64_t begin = padded(at, 64);
      at = begin + bytes;
      return begin;
    };
    blocks = padded(h.count, kBlock) / kBlock;
    centers = section(h.count * h.dim * h.item_size);
    order = section(h.count * 4);
    relative = section(blocks * kBlock * h.dim * 4);
    boxes = section(padded(blocks, kBlock) * h.dim * 2 * 4);
    end = padded(at, 64);
  }
};

struct Index {
  Header header;
  int64_t blocks;
  const int32_t* order;   // (M,) rank -> row of the centers
  const float* relative;  // (blocks, D, kBlock) center - low, by rank; the padding is far away
  const float* boxes;     // (tiles, 2, D, kBlock) low and high corners of the blocks, 16 a tile
};

Index view_of(const char* bytes) {
  Index index;
  std::memcpy(&index.header, bytes, sizeof(Header));
  const Sections at(index.header);
  index.blocks = at.blocks;
  index.order = reinterpret_cast<const int32_t*>(bytes + at.order);
  index.relative = reinterpret_cast<const float*>(bytes + at.relative);
  index.boxes = reinterpret_cast<const float*>(bytes + at.boxes);
  return index;
}

// Whether the bytes are an index of exactly these centers.
template <class T, int D>
bool matches(const char* bytes, int64_t size, const T* centers, int64_t count) {
  Header h;
  if (size < int64_t(sizeof(Header)) || reinterpret_cast<uintptr_t>(bytes) % 8 != 0) return false;
  std::memcpy(&h, bytes, sizeof(Header));
  if (h.magic != kMagic || h.bytes != size || h.checksum != checksum(h)) return false;
  if (h.count != count || h.dim != D || h.item_size != int(sizeof(T))) return false;
  const Sections at(h);
  if (at.end != size) return false;
  const auto* order = reinterpret_cast<const uint32_t*>(bytes + at.order);
  uint32_t largest = 0;
  for (int64_t i = 0; i < count; ++i) largest = std::max(largest, order[i]);
  return (count == 0 || largest < count) &&
         std::memcmp(bytes + at.centers, centers, sizeof(T) * D * count) == 0;
}

template <class T, int D>
struct Box {
  T low[D], high[D];

  Box() {
    for (int d = 0; d < D; ++d) {
      low[d] = std::numeric_limits<T>::infinity();
      high[d] = -low[d];
    }
  }

  // Takes in the finite coordinates of the rows begin .. end; false where some are not finite.
  bool add(const T* points, int64_t begin, int64_t end, int64_t step) {
    constexpr int kRun = 16 * D;
    T lowest[kRun], highest[kRun], sum[kRun] = {};
    for (int i = 0; i < kRun; ++i) lowest[i] = low[i % D], highest[i] = high[i % D];
    for (int64_t row = begin; row < end; row += 16 * step) {
      const T* run = points + row * D;
      if (step > 1 || row + 16 > end) {
        for (int64_t one = row; one < std::min(end, row + 16 * step); one += step)
          add_run<D>(points + one * D, lowest, highest, sum);
      } else {
        add_run<kRun>(run, lowest, highest, sum);
      }
    }
    T total = 0;
    for (int i = 0; i < kRun; ++i) {
      low[i % D] = std::min(low[i % D], lowest[i]);
      high[i % D] = std::max(high[i % D], highest[i]);
      total += sum[i];
    }
    return total == T(0);
  }

  template <int Run>
  static void add_run(const T* run, T* lowest, T* highest, T* sum) {
    const T largest = std::numeric_limits<T>::max();
    for (int i = 0; i < Run; ++i) {
      const T x = run[i];
      sum[i] += x * T(0);
      lowest[i] = x < lowest[i] && x >= -largest ? x : lowest[i];
      highest[i] = x > highest[i] && x <= largest ? x : highest[i];
    }
  }
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

  void counting_pass(int shift, int bits) {
    const uint32_t mask = (1u << bits) - 1;
    histogram.assign(int64_t(mask) + 2, 0);
    for (uint64_t item : items) ++histogram[((item >> shift) & mask) + 1];
    for (uint32_t digit = 0; digit < mask; ++digit) histogram[digit + 1] += histogram[digit];
    other.resize(items.size());
    for (uint64_t item : items) other[histogram[(item >> shift) & mask]++] = item;
    items.swap(other);
  }

  void sort(int key_bits) {
    const int passes = key_bits <= 12 ? 1 : (key_bits + 10) / 11;
    for (int pass = 0; pass < passes; ++pass) {
      const int shift = key_bits * pass / passes;
      counting_pass(32 + shift, key_bits * (pass + 1) / passes - shift);
    }
  }
};

// Z curve: how the bits of the cells along the axes interleave, coarse cells first.
template <int D>
struct ZCurve {
  float scale;  // cells a meter
  int32_t last[D];
  int bits = 0;
  std::vector<uint32_t> spread[D];

  // About `cells` cubes over a box with these edges, at most 2^10 along an axis.
  ZCurve(const double* edges, double cells) {
    double largest = 0, volume = 1, shortest = 0;
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

  void assign_bit(int d, int level) {
    for (int32_t cell = 0; cell <= last[d]; ++cell)
      spread[d][cell] |= uint32_t((cell >> level) & 1) << bits;
    ++bits;
  }

  // Items for the rows first .. first + n of points, n <= 16, keyed by their cells.
  template <class T>
  void make_items(const T* points, const T* low, int64_t first, int n, uint64_t* items) const {
    int32_t cell[D][16];
    for (int d = 0; d < D; ++d) {
      const float largest = float(last[d]);
      float at[16] = {};
      for (int j = 0; j < n; ++j) at[j] = float(points[(first + j) * D + d] - low[d]) * scale;
      for (int j = 0; j < 16; ++j) {
        at[j] = at[j] > 0 ? at[j] : 0;  // NaN, too
        cell[d][j] = int32_t(at[j] < largest ? at[j] : largest);
      }
    }
    for (int j = 0; j < n; ++j) {
      uint32_t key = 0;
      for (int d = 0; d < D; ++d) key |= spread[d][cell[d][j]];
      items[j] = uint64_t(key) << 32 | uint64_t(j);
    }
  }

  template <class T>
  void sort(const T* points, const T* low, int64_t n, Sorter& sorter) const {
    sorter.items.resize(n);
    for (int64_t i = 0; i < n; i += 16) {
      make_items(points, low, i, int(std::min<int64_t>(16, n - i)), sorter.items.data() + i);
      for (int64_t j = i; j < std::min(n, i + 16); ++j) sorter.items[j] += uint64_t(i);
    }
    sorter.sort(bits);
  }
};

template <class T, int D>
struct IndexBuilder {
  Header header{};
  const T* centers;
  std::vector<int32_t> order;

  IndexBuilder(const T* centers_, int64_t count) : centers(centers_) {
    Box<T, D> box;
    box.add(centers, 0, count, 1);
    const bool any = box.low[0] <= box.high[0];
    header.magic = kMagic;
    header.count = count;
    header.dim = D;
    header.item_size = sizeof(T);
    for (int d = 0; d < D; ++d) {
      header.low[d] = any ? double(box.low[d]) : 0.0;
      header.high[d] = any ? double(box.high[d]) : 0.0;
    }
    header.bytes = Sections(header).end;
    header.checksum = checksum(header);
    sort_centers();
  }

  float relative(int64_t row, int d) const {
    return float(centers[row * D + d] - T(header.low[d]));
  }

  void sort_centers() {
    double edges[D];
    for (int d = 0; d < D; ++d) edges[d] = header.high[d] - header.low[d];
    T low[D];
    for (int d = 0; d < D; ++d) low[d] = T(header.low[d]);
    Sorter sorter;
    ZCurve<D>(edges, double(4 * header.count + 1)).sort(centers, low, header.count, sorter);
    order.resize(header.count);
    for (int64_t rank = 0; rank < header.count; ++rank) order[rank] = int32_t(sorter.items[rank]);
  }

  void write(char* to) const {
    const Sections at(header);
    std::memset(to, 0, at.end);  // gaps, too: equal centers give equal bytes
    std::memcpy(to, &header, sizeof(Header));
    std::memcpy(to + at.centers, centers, sizeof(T) * D * header.count);
    std::memcpy(to + at.order, order.data(), 4 * order.size());
    auto* relative_to = reinterpret_cast<float*>(to + at.relative);
    auto* boxes = reinterpret_cast<float*>(to + at.boxes);
    const int64_t tiles = padded(at.blocks, kBlock) / kBlock;
    std::fill(relative_to, relative_to + at.blocks * kBlock * D, kFarAway);
    std::fill(boxes, boxes + tiles * kBlock * D * 2, kFarAway);
    for (int64_t block = 0; block < at.blocks; ++block) {
      float* box = boxes + block / kBlock * kBlock * D * 2 + block % kBlock;
      for (int d = 0; d < D; ++d)
        write_axis(block, d, relative_to + (block * D + d) * kBlock, box + d * kBlock,
                   box + (D + d) * kBlock);
    }
  }

  void write_axis(int64_t block, int d, float* to, float* low, float* high) const {
    const int64_t first = block * kBlock;
    const int members = int(std::min<int64_t>(kBlock, header.count - first));
    for (int i = 0; i < members; ++i) {
      const float x = relative(order[first + i], d);
      if (std::isfinite(x)) to[i] = x;
    }
    *low = *std::min_element(to, to + members);
    *high = *std::max_element(to, to + members);
  }
};

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

// ---------------------------------------------------------------------------------------------
// Parameters of the clusters by rank, packed once a call.

// Doubles where the linear algebra reads: position (x, y, z, -) and shape, each in one cache line.
template <int D>
struct Layout {
  static constexpr int position = D == 3 ? 4 : 2;  // center
  static constexpr int shape = D == 3 ? 8 : 4;     // 1 / diagonal, below the diagonal, weight
  static constexpr int below = D, weight = D + D * (D - 1) / 2;
  static constexpr int gradient = D == 3 ? 12 : 8;  // weight, center, factor; rest unused
};

template <class T>
struct AlignedArray {
  std::unique_ptr<char[]> bytes;
  T* data = nullptr;

  void allocate(int64_t count) {
    bytes.reset(new char[count * sizeof(T) + 64]);
    data = reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(bytes.get()) + 63) / 64 * 64);
  }
};

constexpr int64_t kPackGrain = 512;  // blocks packed in one go

// Parameters by rank. Packed all at once, or, for a few points of a large map, a block when it is
// first a candidate. Without factors and weights, positions alone.
template <class T, int D>
struct Parameters {
  const Index& index;
  const T *centers, *scale_tril, *weights;
  AlignedArray<T> positions, shapes;
  std::vector<char> packed;  // blocks; empty when all are

  Parameters(const Index& index_, const T* centers_, const T* scale_tril_, const T* weights_,
             bool all)
      : index(index_), centers(centers_), scale_tril(scale_tril_), weights(weights_) {
    positions.allocate(index.header.count * Layout<D>::position);
    if (scale_tril) shapes.allocate(index.header.count * Layout<D>::shape);
    if (!all) packed.assign(index.blocks, 0);
    if (!all) return;
    run_tasks((index.blocks + kPackGrain - 1) / kPackGrain, [&](int64_t task) {
      const int64_t end = std::min(index.blocks, (task + 1) * kPackGrain);
      for (int64_t block = task * kPackGrain; block < end; ++block) pack(block);
    });
  }

  void need(const std::vector<int32_t>& ranks, int64_t size) {
    for (int64_t i = 0; i < size; ++i) {
      char& done = packed[ranks[i] / kBlock];
      if (!done) pack(ranks[i] / kBlock);
      done = 1;
    }
  }

  void pack(int64_t block) {
    const int64_t count = index.header.count, end = std::min(count, (block + 1) * kBlock);
    for (int64_t rank = block * kBlock; rank < end; ++rank) {
      const int64_t soon = index.order[std::min(rank + kBlock, count - 1)];
      __builtin_prefetch(centers + soon * D);
      pack_position(centers + int64_t(index.order[rank]) * D, rank);
      if (!scale_tril) continue;
      __builtin_prefetch(scale_tril + soon * D * D);
      pack_shape(index.order[rank], rank);
    }
  }

  // A center that is not finite is farther than any other.
  void pack_position(const T* center, int64_t rank) {
    T* to = positions.data + rank * Layout<D>::position;
    const bool finite = is_finite(center, D);
    for (int d = 0; d < Layout<D>::position; ++d)
      to[d] = d >= D ? T(0) : finite ? center[d] : std::numeric_limits<T>::infinity();
  }

  void pack_shape(int64_t row, int64_t rank) {
    using L = Layout<D>;
    const T* factor = scale_tril + row * D * D;
    T* to = shapes.data + rank * L::shape;
    for (int i = 0; i < D; ++i) to[i] = T(1) / factor[i * D + i];
    to[L::below] = factor[D];
    if (D == 3) {
      to[L::below + 1] = factor[2 * D];
      to[L::below + 2] = factor[2 * D + 1];
    }
    to[L::weight] = weights[row];
  }
};

// ---------------------------------------------------------------------------------------------
// Candidates: centers that can be among the k nearest of some point of a box.

constexpr int kWide = Simd<float>::W;
using Wide = Simd<float>::V;
using WideInt = Simd<float>::I;

// Box of points, relative to the corner of the centers' box, grown by what rounding can do.
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

// Lanes of `bits` set to the front; writes a whole register.
template <class X>
inline void compress(uint32_t bits, const X* from, X* to) {
#if defined(LARDHM_AVX512)
  _mm512_storeu_si512(to, _mm512_maskz_compress_epi32(uint16_t(bits), _mm512_loadu_si512(from)));
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

  // Those of the index within the radius of the region.
  void collect(const Index& index, const Region<D>& region, float radius) {
    block.resize(index.blocks + kWide);
    for (int d = 0; d < D; ++d) {
      low[d].resize(index.blocks + kWide);
      high[d].resize(index.blocks + kWide);
    }
    const WideInt limit = squared_as_bits(radius * 1.0001f);
    size = 0;
    for (int64_t i = 0; i < index.blocks; i += kWide) {
      const float *low_at[D], *high_at[D];
      for (int d = 0; d < D; ++d) {
        low_at[d] = index.boxes + i / kBlock * kBlock * D * 2 + d * kBlock + i % kBlock;
        high_at[d] = low_at[d] + D * kBlock;
      }
      const uint32_t keep =
          boxes_within(region, low_at, high_at, limit) & existing(i, index.blocks);
      if (!keep) continue;
      compress(keep, Numbers(i).lane, block.data() + size);
      for (int d = 0; d < D; ++d) compress(keep, low_at[d], low[d].data() + size);
      for (int d = 0; d < D; ++d) compress(keep, high_at[d], high[d].data() + size);
      size += __builtin_popcount(keep);
    }
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

// ---------------------------------------------------------------------------------------------
// Packets: neighboring points, one a lane.

template <class T, int D>
struct Packet {
  typename Simd<T>::V x[D];
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

template <class T, int D>
using KthFn = typename Simd<T>::I (*)(const Packet<T, D>&, const T*, const int32_t*, int64_t, int,
                                      typename Simd<T>::I*);

template <class T, int D>
KthFn<T, D> kth_distance_for(int k) {
#define LARDHM_USE(K) return &kth_distance<T, D, K>
  LARDHM_FOR_K(k, LARDHM_USE)
#undef LARDHM_USE
}

constexpr int64_t kMostPoints = 2048;  // in a region
constexpr double kRegionPoints = 6000, kGroupPoints = 128, kSparse = 25;

// How many sorted points share a list of blocks, a list of candidates, a register. The fewer points
// there are a center, the more centers lie between neighbors: where they are very sparse, a point
// by itself has the shortest list.
struct Sharing {
  int64_t region, group, packet;

  Sharing(int64_t points, int64_t centers, int64_t lanes) {
    const double sparsity = std::max(1.0, double(centers) / double(std::max<int64_t>(points, 1)));
    region = std::max<int64_t>(1, std::min(kMostPoints, int64_t(kRegionPoints / sparsity)));
    group = std::max<int64_t>(lanes, int64_t(kGroupPoints / sparsity));
    packet = lanes;
    if (sparsity > kSparse) group = packet = 1;
  }
};

constexpr double kPointsPerCell = 4;     // of the Z curve

// What one thread needs while it works through points.
template <class T, int D>
struct Scratch {
  Sorter sorter;
  std::vector<int32_t> order;  // of a region's points along the Z curve
  std::vector<T> x[D];         // their coordinates
  Blocks<D> far;
  Candidates<D> near;
  std::vector<int32_t> list;
  std::vector<uint32_t> bits;  // lanes that select each of the list
  Sharing sharing{0, 0, 1};
  Region<D> region, group;
  float far_radius = 0, near_radius = 0, radius = 0;  // [m] how far the lists and a packet look
  AlignedArray<typename Simd<T>::I> distance;
  int64_t room = 0;
  Selection selected;

  void reserve_list(int64_t n) {
    if (n <= room) return;
    room = 2 * n;
    list.resize(room + kWide);
    distance.allocate(room);
    bits.resize(room + kWide);
    selected.rank.resize(room + kWide);
    selected.bits.resize(room + kWide);
  }
};

template <class T, int D>
struct Engine {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  static constexpr int W = Simd<T>::W;

  Index index;
  const T* points;
  Parameters<T, D>& parameters;
  const T* positions;
  int k;
  KthFn<T, D> kth;
  T origin[D];
  float reach, smallest_radius;  // [m] edge of the centers' box; where guesses begin

  Engine(const T* points_, Parameters<T, D>& parameters_, int64_t k_)
      : index(parameters_.index), points(points_), parameters(parameters_),
        positions(parameters_.positions.data), k(int(k_)),
        kth(kth_distance_for<T, D>(int(k_))), reach(0) {
    for (int d = 0; d < D; ++d) {
      origin[d] = T(index.header.low[d]);
      reach = std::max(reach, float(index.header.high[d] - index.header.low[d]));
    }
    smallest_radius = std::max(1e-18f, 1e-4f * reach);
  }

  // Sorts the finite points along a Z curve over their box, s.sorter.items; others are shown to
  // the visitor at once. Returns how many are left.
  template <class Visitor>
  int64_t sort_points(int64_t begin, int64_t end, Scratch<T, D>& s, Visitor& visitor) const {
    Box<T, D> box;
    const bool all_finite = box.add(points, begin, end, 1);
    double edges[D];
    T low[D];
    for (int d = 0; d < D; ++d) {
      // Far outside the centers' box the order matters little, and would cost resolution inside.
      low[d] = std::max(box.low[d], T(index.header.low[d] - 0.5 * reach));
      const T high = std::min(box.high[d], T(index.header.high[d] + 0.5 * reach));
      edges[d] = std::max(double(high) - double(low[d]), 0.0);
    }
    const ZCurve<D> curve(edges, std::max<double>(1, double(end - begin) / kPointsPerCell));
    curve.sort(points + begin * D, low, end - begin, s.sorter);
    if (all_finite) return end - begin;
    int64_t kept = 0;
    for (uint64_t item : s.sorter.items) {
      const int64_t row = begin + int64_t(uint32_t(item));
      if (is_finite(points + row * D, D))
        s.sorter.items[kept++] = item;
      else
        visitor.invalid(row);
    }
    return kept;
  }

  // Sorted points first .. stop axis by axis.
  void gather(int64_t begin, int64_t first, int64_t stop, Scratch<T, D>& s) const {
    constexpr int64_t kAhead = 24;
    const int64_t n = stop - first, last = int64_t(s.sorter.items.size()) - 1;
    const uint64_t* items = s.sorter.items.data();
    for (int64_t i = 0; i < n; ++i) {
      __builtin_prefetch(
          points + (begin + uint32_t(items[std::min(first + i + kAhead, last)])) * D);
      s.order[i] = int32_t(items[first + i]);
      const T* point = points + (begin + s.order[i]) * D;
      for (int d = 0; d < D; ++d) s.x[d][i] = point[d];
    }
  }

  // Where the run of sorted points i .. stop should end: not across a border of the Z curve's cells
  // whose cell holds many more points, for the curve jumps there and the run's box would be large.
  static int64_t cut(const std::vector<uint64_t>& items, int64_t n, int64_t i, int64_t stop) {
    const int64_t around = 2 * (stop - i);
    const auto key = [&items](int64_t at) { return uint32_t(items[at] >> 32); };
    while (key(i) != key(stop - 1)) {
      const int bit = 31 - __builtin_clz(key(i) ^ key(stop - 1));
      const uint32_t cell = key(i) >> (bit + 1);
      const bool crowded = (i >= around && key(i - around) >> (bit + 1) == cell) ||
                           (stop - 1 + around < n && key(stop - 1 + around) >> (bit + 1) == cell);
      if (!crowded) break;
      const uint64_t border = uint64_t(key(stop - 1) >> bit << bit) << 32;
      stop = std::lower_bound(items.begin() + i, items.begin() + stop, border) - items.begin();
    }
    return stop;
  }

  // One register of coordinates; lanes from `end` on hold the last point before it.
  static V coordinates(const std::vector<T>& x, int64_t i, int64_t end) {
    const V all = load<V>(x.data() + i);
    if (i + W <= end) return all;
    I lane;
    for (int j = 0; j < W; ++j) lane[j] = j;
    const typename Simd<T>::Int count = end - i;
    return lane < count ? all : x[end - 1] - V{};
  }

  static Box<T, D> box_of_sorted(const Scratch<T, D>& s, int64_t begin, int64_t end) {
    Box<T, D> box;
    for (int d = 0; d < D; ++d) {
      V low = coordinates(s.x[d], begin, end), high = low;
      for (int64_t i = begin + W; i < end; i += W) {
        const V x = coordinates(s.x[d], i, end);
        low = x < low ? x : low;
        high = x > high ? x : high;
      }
      box.low[d] = smallest_lane<T>(low);
      box.high[d] = -smallest_lane<T>(-high);
    }
    return box;
  }

  // Fills s.selected with the listed centers within the limit, k in each lane; ties go to the lower
  // row of the centers.
  void select(const Packet<T, D>& packet, I limit, int64_t n, Scratch<T, D>& s) const {
    const uint32_t all = ~0u >> (32 - packet.lanes);
    I count = {};
    for (int64_t i = 0; i < n; ++i) {
      const I distance = s.distance.data[i];
      s.bits[i] = bits_le<I>(distance, limit) & all;
      count -= distance <= limit;
    }
    const typename Simd<T>::Int most = k;
    if ((bits_le<I>(count, most - I{}) & all) != all) break_ties(packet.lanes, limit, n, s);
    s.selected.size = 0;
    for (int64_t i = 0; i < n; i += kWide) {
      uint32_t some = ~bits_le<WideInt>(load<WideInt>(s.bits.data() + i), WideInt{});
      some &= existing(i, n);
      compress(some, s.list.data() + i, s.selected.rank.data() + s.selected.size);
      compress(some, s.bits.data() + i, s.selected.bits.data() + s.selected.size);
      s.selected.size += __builtin_popcount(some);
    }
  }

  // Of the candidates at exactly the k-th distance of a lane, keeps those of the lowest rows.
  void break_ties(int lanes, I limit, int64_t n, Scratch<T, D>& s) const {
    std::vector<std::pair<int32_t, int64_t>> tied;
    for (int lane = 0; lane < lanes; ++lane) {
      int nearer = 0;
      tied.clear();
      for (int64_t i = 0; i < n; ++i) {
        if (s.distance.data[i][lane] < limit[lane]) ++nearer;
        if (s.distance.data[i][lane] == limit[lane])
          tied.emplace_back(index.order[s.list[i]], i);
      }
      std::sort(tied.begin(), tied.end());
      for (size_t i = size_t(k - nearer); i < tied.size(); ++i)
        s.bits[tied[i].second] &= ~(1u << lane);
    }
  }

  // Shows the visitor the points begin .. end: packet by packet with s.selected filled in, or one
  // by one where a coordinate is not finite.
  template <class Visitor>
  void visit(int64_t begin, int64_t end, Scratch<T, D>& s, Visitor& visitor) const {
    const int64_t n = sort_points(begin, end, s, visitor);
    s.order.resize(kMostPoints);
    for (int d = 0; d < D; ++d) s.x[d].resize(kMostPoints + W);
    s.sharing = Sharing(n, index.header.count, W);
    for (int64_t i = 0, stop; i < n; i = stop) {
      stop = cut(s.sorter.items, n, i, std::min(n, i + s.sharing.region));
      gather(begin, i, stop, s);
      s.region = region_of(s, 0, stop - i);
      s.far_radius = -1;
      for (int64_t j = i, end; j < stop; j = end) {
        end = cut(s.sorter.items, n, j, std::min(stop, j + s.sharing.group));
        s.group = region_of(s, j - i, end - i);
        s.near_radius = -1;
        visit_group(begin, n, i, j, end, s, visitor);
      }
    }
  }

  Region<D> region_of(const Scratch<T, D>& s, int64_t begin, int64_t end) const {
    return Region<D>(box_of_sorted(s, begin, end), origin, reach);
  }

  // The sorted points i .. stop of the region that begins at `first`.
  template <class Visitor>
  void visit_group(int64_t begin, int64_t n, int64_t first, int64_t i, int64_t stop,
                   Scratch<T, D>& s, Visitor& visitor) const {
    Packet<T, D> packet;
    for (int64_t end; i < stop; i = end) {
      end = cut(s.sorter.items, n, i, std::min(stop, i + s.sharing.packet));
      packet.begin = begin;
      packet.order = s.order.data() + (i - first);
      packet.lanes = int(end - i);
      for (int d = 0; d < D; ++d) packet.x[d] = coordinates(s.x[d], i - first, end - first);
      search(packet, region_of(s, i - first, end - first), s);
      visitor.packet(packet, s.selected);
    }
  }

  // Selects among the centers within a radius of the packet: a guess from the packet before. Where
  // the k-th distance turns out larger, that distance is the radius of the second attempt.
  void search(const Packet<T, D>& packet, const Region<D>& region, Scratch<T, D>& s) const {
    float radius = std::max(s.radius, smallest_radius);
    for (;;) {
      if (radius > s.near_radius) look_farther(1.3f * radius, s);
      const int64_t n = s.near.pick(region, radius, s.list.data());
      if (n < k) {
        radius = 2 * radius;
        continue;
      }
      const I limit = kth(packet, positions, s.list.data(), n, k, s.distance.data);
      const float farthest = std::sqrt(float(-smallest_lane<T>(-(V)limit))) * 1.00001f;
      if (farthest <= radius) {
        s.radius = farthest * 1.15f;
        return select(packet, limit, n, s);
      }
      radius = farthest;
    }
  }

  // Fills s.near with the centers within the radius of the group, and s.far, of the region.
  void look_farther(float radius, Scratch<T, D>& s) const {
    if (radius > s.far_radius) {
      s.far_radius = 1.3f * radius;
      s.far.collect(index, s.region, s.far_radius);
    }
    s.near_radius = radius;
    s.near.collect(index, s.far, s.group, radius);
    if (!parameters.packed.empty()) parameters.need(s.near.rank, s.near.size);
    s.reserve_list(s.near.size);
  }
};

// ---------------------------------------------------------------------------------------------
// Visitors: what is done with a packet and the clusters it selected.

// Whitened offset z = inv(L) (x - c) of a packet from one cluster.
template <class T, int D>
inline void whiten(const Packet<T, D>& packet, const T* center, const T* shape,
                   typename Simd<T>::V* z) {
  const T* below = shape + Layout<D>::below;
  z[0] = (packet.x[0] - center[0]) * shape[0];
  z[1] = ((packet.x[1] - center[1]) - z[0] * below[0]) * shape[1];
  if constexpr (D == 3)
    z[2] = ((packet.x[2] - center[2]) - z[0] * below[1] - z[1] * below[2]) * shape[2];
}

template <class T, int D>
inline typename Simd<T>::V kernel_of(const typename Simd<T>::V* z) {
  typename Simd<T>::V squared = z[0] * z[0];
  for (int d = 1; d < D; ++d) squared += z[d] * z[d];
  return exp_negative<T>(squared * T(-0.5));
}

template <class T, int D>
inline void store_rows(typename Simd<T>::V value, const Packet<T, D>& packet, T* to) {
  T lane_value[Simd<T>::W];
  std::memcpy(lane_value, &value, sizeof(value));
  for (int lane = 0; lane < packet.lanes; ++lane) to[packet.row(lane)] = lane_value[lane];
}

template <class T, int D>
struct OccupancyVisitor {
  using V = typename Simd<T>::V;
  const T *positions, *shapes;
  bool probability;
  T* out;

  void invalid(int64_t row) { out[row] = std::numeric_limits<T>::quiet_NaN(); }

  void packet(const Packet<T, D>& packet, const Selection& selected) {
    using L = Layout<D>;
    V sum = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      V z[D];
      whiten<T, D>(packet, positions + int64_t(selected.rank[j]) * L::position, shape, z);
      const V term = kernel_of<T, D>(z) * shape[L::weight];
      sum = mask_of<T>(selected.bits[j]) ? sum + term : sum;
    }
    store_rows<T, D>(probability ? sigmoid<T>(sum) : sum, packet, out);
  }
};

template <class T, int D>
struct NearestVisitor {
  const int32_t* order;
  int64_t k;
  int64_t* out;

  void invalid(int64_t row) {
    for (int64_t j = 0; j < k; ++j) out[row * k + j] = j;
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) {
    int64_t filled[Simd<T>::W] = {};
    for (int64_t j = 0; j < selected.size; ++j)
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        insert(out + packet.row(lane) * k, filled[lane]++, order[selected.rank[j]]);
      }
  }

  static void insert(int64_t* sorted, int64_t n, int64_t value) {
    for (; n > 0 && sorted[n - 1] > value; --n) sorted[n] = sorted[n - 1];
    sorted[n] = value;
  }
};

enum Wanted { kPoints = 1, kCenters = 2, kScaleTril = 4, kWeights = 8 };

// Gradients: `sums` holds, for each cluster by rank, those of weight, center and factor.
template <class T, int D>
struct BackwardVisitor {
  using V = typename Simd<T>::V;
  using L = Layout<D>;
  const T *positions, *shapes, *grad;
  bool probability;
  int64_t wanted;
  T *grad_points, *sums;
  std::vector<char> bytes;

  void invalid(int64_t row) {
    if (!(wanted & kPoints)) return;
    for (int d = 0; d < D; ++d) grad_points[row * D + d] = std::numeric_limits<T>::quiet_NaN();
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) {
    bytes.resize((selected.size + 1) * (D + 1) * sizeof(V) + 64);
    V* terms = reinterpret_cast<V*>((reinterpret_cast<uintptr_t>(bytes.data()) + 63) / 64 * 64);
    const V g = incoming(packet, selected, terms);
    V towards[D] = {};
    for (int64_t j = 0; j < selected.size; ++j)
      cluster(selected.rank[j], g, terms + j * (D + 1), towards);
    if (!(wanted & kPoints)) return;
    for (int lane = 0; lane < packet.lanes; ++lane)
      for (int d = 0; d < D; ++d) grad_points[packet.row(lane) * D + d] = -towards[d][lane];
  }

  // Gradient that reaches the log-odds; the terms of a cluster are z and the masked kernel value.
  V incoming(const Packet<T, D>& packet, const Selection& selected, V* terms) const {
    V sum = {}, g = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      V* z = terms + j * (D + 1);
      whiten<T, D>(packet, positions + int64_t(selected.rank[j]) * L::position, shape, z);
      z[D] = mask_of<T>(selected.bits[j]) ? kernel_of<T, D>(z) : V{};
      sum += z[D] * shape[L::weight];
    }
    for (int lane = 0; lane < packet.lanes; ++lane) g[lane] = grad[packet.row(lane)];
    if (!probability) return g;
    const V p = sigmoid<T>(sum);
    return g * p * sigmoid<T>(-sum);
  }

  // Adds one cluster's share; y = inv(L)^T z, d log_odds / dc = w phi y, dL = w phi y z^T.
  void cluster(int32_t rank, V g, const V* z, V* towards) {
    const T* shape = shapes + int64_t(rank) * L::shape;
    T* sum = sums + int64_t(rank) * L::gradient;
    const V by_weight = g * z[D];
    if (wanted & kWeights) sum[0] += sum_lanes<T>(by_weight);
    if (!(wanted & (kPoints | kCenters | kScaleTril))) return;
    const T* below = shape + L::below;
    const V share = by_weight * shape[L::weight];
    V y[D];
    y[D - 1] = share * z[D - 1] * shape[D - 1];
    if constexpr (D == 3) y[1] = (share * z[1] - y[2] * below[2]) * shape[1];
    y[0] = share * z[0] - y[1] * below[0];
    if constexpr (D == 3) y[0] -= y[2] * below[1];
    y[0] *= shape[0];
    for (int d = 0; d < D; ++d) towards[d] += y[d];
    if (wanted & kCenters)
      for (int d = 0; d < D; ++d) sum[1 + d] += sum_lanes<T>(y[d]);
    if (!(wanted & kScaleTril)) return;
    T* factor = sum + 1 + D;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j) *factor++ += sum_lanes<T>(y[i] * z[j]);
  }
};

// k = 1: the own center of every point, and the moments of the offsets from it.
template <class T, int D>
struct AssignVisitor {
  static constexpr int kMoments = 1 + D + D * (D + 1) / 2;
  const int32_t* order;
  const T* positions;
  bool scatter;
  int64_t* labels;
  double* sums;  // (M, kMoments) by rank: count, offsets, lower triangle of their products

  void invalid(int64_t row) { labels[row] = -1; }

  void packet(const Packet<T, D>& packet, const Selection& selected) {
    for (int64_t j = 0; j < selected.size; ++j) {
      const int64_t rank = selected.rank[j];
      const T* center = positions + rank * Layout<D>::position;
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        labels[packet.row(lane)] = order[rank];
        T offset[D];
        for (int d = 0; d < D; ++d) offset[d] = packet.x[d][lane] - center[d];
        add(offset, sums + rank * kMoments);
      }
    }
  }

  void add(const T* offset, double* to) const {
    to[0] += 1;
    for (int d = 0; d < D; ++d) to[1 + d] += offset[d];
    if (!scatter) return;
    double* product = to + 1 + D;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j) *product++ += double(offset[i]) * double(offset[j]);
  }
};

// ---------------------------------------------------------------------------------------------
// Running a visitor over all points.

constexpr int64_t kSmallBlock = 32768;
constexpr int64_t kPointsOfFew = 64;  // fewer than clusters / 64: parameters packed as needed
constexpr int64_t kLargeBlock = int64_t(1) << 20;

// An index for the call: the one given where it fits, else one of its own.
template <class T, int D>
struct CallIndex {
  AlignedArray<char> own;
  Index index;

  CallIndex(const Tensor& given, const T* centers, int64_t count) {
    const char* bytes = static_cast<const char*>(given.const_data_ptr());
    if (!matches<T, D>(bytes, given.numel(), centers, count)) {
      const IndexBuilder<T, D> builder(centers, count);
      own.allocate(builder.header.bytes);
      builder.write(own.data);
      bytes = own.data;
    }
    index = view_of(bytes);
  }
};

template <class T, int D>
double volume_of(const Engine<T, D>& engine, int64_t begin, int64_t end, int64_t step) {
  Box<T, D> box;
  box.add(engine.points, begin, end, step);
  double volume = 1;
  for (int d = 0; d < D; ++d)
    volume *= std::max(double(box.high[d]) - double(box.low[d]), 0.01 * engine.reach);
  return volume;
}

// Points sorted together: small blocks stay in the cache, and are enough where points that follow
// each other lie close together, as in lattices and scans; shuffled points need large ones.
template <class T, int D>
int64_t block_size(const Engine<T, D>& engine, int64_t n, int64_t workers) {
  const int64_t share = std::max<int64_t>((n + workers - 1) / workers, 256);
  if (share <= kSmallBlock) return share;
  const double all = volume_of(engine, 0, n, n / 512);
  double blocks = 0;
  for (int64_t i = 0; i < 4; ++i) {
    const int64_t begin = (n - kSmallBlock) / 4 * i;
    blocks += 0.25 * volume_of(engine, begin, begin + kSmallBlock, kSmallBlock / 512);
  }
  const bool coherent = blocks * double(n) < 3 * all * double(kSmallBlock);
  return coherent ? kSmallBlock : std::min(share, kLargeBlock);
}

// Runs a copy of the visitor over blocks of points, on all threads.
template <class T, int D, class Visitor>
void visit_all(const Engine<T, D>& engine, int64_t n, const Visitor& visitor) {
  if (n == 0) return;
  const int64_t threads = engine.parameters.packed.empty() ? num_threads() : 1;
  const int64_t block = block_size(engine, n, threads);
  const int64_t blocks = (n + block - 1) / block;
  std::atomic<int64_t> next{0};
  run_tasks(std::min(blocks, threads), [&](int64_t) {
    Scratch<T, D> scratch;
    Visitor own = visitor;
    for (int64_t i = next++; i < blocks; i = next++)
      engine.visit(i * block, std::min(n, (i + 1) * block), scratch, own);
  });
}

// Parts of the points in a fixed order, each with sums of its own: the result depends on the
// number of parts, not on the threads' timing. `make(part)` gives the part's visitor.
template <class T, int D, class Make>
void visit_parts(const Engine<T, D>& engine, int64_t n, int64_t parts, const Make& make) {
  const int64_t block = block_size(engine, n, parts);
  run_tasks(parts, [&](int64_t part) {
    Scratch<T, D> scratch;
    auto visitor = make(part);
    const int64_t begin = n * part / parts, end = n * (part + 1) / parts;
    for (int64_t i = begin; i < end; i += block)
      engine.visit(i, std::min(end, i + block), scratch, visitor);
  });
}

// How many parts to sum in: one a thread, fewer where the sums outweigh the work.
int64_t parts_of(int64_t n, int64_t bytes_of_sums) {
  const int64_t by_work = (n + 1023) / 1024;
  const int64_t by_memory = (int64_t(1) << 29) / std::max<int64_t>(bytes_of_sums, 1);
  return std::max<int64_t>(1, std::min({num_threads(), by_work, by_memory}));
}

// ---------------------------------------------------------------------------------------------
// Ops.

Tensor tidy(const Tensor& tensor) { return torch::stable::contiguous(tensor); }

template <class T>
const T* in(const Tensor& tensor) {
  return static_cast<const T*>(tensor.const_data_ptr());
}

template <class T>
T* out(const Tensor& tensor) {
  return static_cast<T*>(tensor.mutable_data_ptr());
}

void check_rows(const char* name, const Tensor& tensor, const Tensor& centers) {
  STD_TORCH_CHECK(tensor.dim() == 2 && tensor.size(1) == centers.size(1), name,
                  " must be (N, D) like the centers; got ", tensor.dim(), " dimensions");
  STD_TORCH_CHECK(tensor.scalar_type() == centers.scalar_type(), name,
                  " must have the dtype of the centers");
}

// Calls use.template operator()<T, D>() for the dtype and dimension of the centers.
template <class Use>
auto dispatch(const Tensor& centers, const Use& use) {
  STD_TORCH_CHECK(centers.dim() == 2 && (centers.size(1) == 2 || centers.size(1) == 3),
                  "centers must be (M, 2) or (M, 3)");
  STD_TORCH_CHECK(centers.size(0) < (int64_t(1) << 30), "centers must be fewer than 2^30");
  const bool plane = centers.size(1) == 2;
  const ScalarType type = centers.scalar_type();
  STD_TORCH_CHECK(type == ScalarType::Float || type == ScalarType::Double,
                  "centers must be float32 or float64");
  if (type == ScalarType::Float)
    return plane ? use(float{}, std::integral_constant<int, 2>{})
                 : use(float{}, std::integral_constant<int, 3>{});
  return plane ? use(double{}, std::integral_constant<int, 2>{})
               : use(double{}, std::integral_constant<int, 3>{});
}

void check_k(int64_t k) { STD_TORCH_CHECK(k >= 1, "k must be at least 1; got ", k); }

// Runs `work(engine)` with an index that fits the centers; factors and weights may be null.
template <class T, int D, class Work>
void with_engine(const Tensor& points, const Tensor& centers, const Tensor* scale_tril,
                 const Tensor* weights, int64_t k, const Tensor& given, const Work& work) {
  const CallIndex<T, D> call(given, in<T>(centers), centers.size(0));
  const bool all = points.size(0) >= centers.size(0) / kPointsOfFew;
  Parameters<T, D> parameters(call.index, in<T>(centers), scale_tril ? in<T>(*scale_tril) : nullptr,
                              weights ? in<T>(*weights) : nullptr, all);
  work(Engine<T, D>(in<T>(points), parameters, k));
}

Tensor build_index(const Tensor& given_centers, int64_t k) {
  check_k(k);
  const Tensor centers = tidy(given_centers);
  return dispatch(centers, [&](auto type, auto dim) {
    const IndexBuilder<decltype(type), dim()> builder(in<decltype(type)>(centers),
                                                      centers.size(0));
    const Tensor index =
        torch::stable::new_empty(centers, {builder.header.bytes}, ScalarType::Byte);
    builder.write(out<char>(index));
    return index;
  });
}

bool index_matches(const Tensor& index, const Tensor& given_centers, int64_t k) {
  check_k(k);
  if (index.scalar_type() != ScalarType::Byte || !index.is_contiguous()) return false;
  const Tensor centers = tidy(given_centers);
  return dispatch(centers, [&](auto type, auto dim) {
    return matches<decltype(type), dim()>(in<char>(index), index.numel(),
                                          in<decltype(type)>(centers), centers.size(0));
  });
}

Tensor usable_index(const Tensor& index) {
  STD_TORCH_CHECK(index.scalar_type() == ScalarType::Byte, "index must be a uint8 tensor");
  return tidy(index);
}

Tensor nearest(const Tensor& given_points, const Tensor& given_centers, int64_t k,
               const Tensor& given_index) {
  check_k(k);
  const Tensor points = tidy(given_points), centers = tidy(given_centers);
  const Tensor index = usable_index(given_index);
  check_rows("points", points, centers);
  k = std::min(k, centers.size(0));
  const Tensor rows = torch::stable::new_empty(points, {points.size(0), k}, ScalarType::Long);
  if (k == 0) return rows;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_engine<T, dim()>(points, centers, nullptr, nullptr, k, index, [&](const auto& engine) {
      visit_all(engine, points.size(0),
                NearestVisitor<T, dim()>{engine.index.order, k, out<int64_t>(rows)});
    });
    return 0;
  });
  return rows;
}

void check_parameters(const Tensor& centers, const Tensor& scale_tril, const Tensor& weights) {
  const int64_t count = centers.size(0), dim = centers.size(1);
  STD_TORCH_CHECK(scale_tril.dim() == 3 && scale_tril.size(0) == count &&
                      scale_tril.size(1) == dim && scale_tril.size(2) == dim,
                  "scale_tril must be (M, D, D), one factor per center");
  STD_TORCH_CHECK(weights.dim() == 1 && weights.size(0) == count,
                  "weights must be (M,), one per center");
  STD_TORCH_CHECK(scale_tril.scalar_type() == centers.scalar_type() &&
                      weights.scalar_type() == centers.scalar_type(),
                  "scale_tril and weights must have the dtype of the centers");
}

// Log-odds of an empty map: 0, and NaN where a coordinate is not finite.
template <class T>
void occupancy_of_nothing(const Tensor& points, bool probability, T* to) {
  const int64_t dim = points.size(1);
  for (int64_t row = 0; row < points.size(0); ++row) {
    T value = probability ? T(0.5) : T(0);
    for (int64_t d = 0; d < dim; ++d) value += in<T>(points)[row * dim + d] * T(0);
    to[row] = value;
  }
}

Tensor occupancy(const Tensor& given_points, const Tensor& given_centers,
                 const Tensor& given_scale_tril, const Tensor& given_weights, int64_t k,
                 const Tensor& given_index, bool probability) {
  check_k(k);
  const Tensor points = tidy(given_points), centers = tidy(given_centers);
  const Tensor scale_tril = tidy(given_scale_tril), weights = tidy(given_weights);
  const Tensor index = usable_index(given_index);
  check_rows("points", points, centers);
  check_parameters(centers, scale_tril, weights);
  k = std::min(k, centers.size(0));
  const Tensor values = torch::stable::new_empty(points, {points.size(0)});
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    if (k == 0) {
      occupancy_of_nothing<T>(points, probability, out<T>(values));
      return 0;
    }
    with_engine<T, dim()>(
        points, centers, &scale_tril, &weights, k, index, [&](const auto& engine) {
          const OccupancyVisitor<T, dim()> visitor{engine.positions, engine.parameters.shapes.data,
                                                   probability, out<T>(values)};
          visit_all(engine, points.size(0), visitor);
        });
    return 0;
  });
  return values;
}

// Sums of the parts, from rank order to the tensors' rows.
template <class T, int D>
void scatter_gradients(const int32_t* order, const T* sums, int64_t parts, int64_t count,
                       T* weights, T* centers, T* scale_tril) {
  using L = Layout<D>;
  run_tasks((count + kPackGrain - 1) / kPackGrain, [&](int64_t task) {
    const int64_t end = std::min(count, (task + 1) * kPackGrain);
    for (int64_t rank = task * kPackGrain; rank < end; ++rank) {
      T sum[L::gradient] = {};
      for (int64_t part = 0; part < parts; ++part)
        for (int i = 0; i < L::gradient; ++i)
          sum[i] += sums[(part * count + rank) * L::gradient + i];
      const int64_t row = order[rank];
      if (weights) weights[row] = sum[0];
      for (int d = 0; centers && d < D; ++d) centers[row * D + d] = sum[1 + d];
      const T* factor = sum + 1 + D;
      for (int i = 0; scale_tril && i < D; ++i)
        for (int j = 0; j < D; ++j)
          scale_tril[(row * D + i) * D + j] = j <= i ? *factor++ : T(0);
    }
  });
}

using Gradients = std::tuple<Tensor, Tensor, Tensor, Tensor>;

Tensor like_or_empty(const Tensor& tensor, bool wanted) {
  return wanted ? torch::stable::new_zeros(tensor, tensor.sizes())
                : torch::stable::new_empty(tensor, {0});
}

Gradients occupancy_backward(const Tensor& given_grad, const Tensor& given_points,
                             const Tensor& given_centers, const Tensor& given_scale_tril,
                             const Tensor& given_weights, int64_t k, const Tensor& given_index,
                             bool probability, int64_t wanted) {
  check_k(k);
  const Tensor grad = tidy(given_grad), points = tidy(given_points);
  const Tensor centers = tidy(given_centers), scale_tril = tidy(given_scale_tril);
  const Tensor weights = tidy(given_weights), index = usable_index(given_index);
  check_rows("points", points, centers);
  check_parameters(centers, scale_tril, weights);
  STD_TORCH_CHECK(grad.dim() == 1 && grad.size(0) == points.size(0) &&
                      grad.scalar_type() == points.scalar_type(),
                  "grad must be (N,), one per point, of the points' dtype");
  const int64_t count = centers.size(0), n = points.size(0);
  const Gradients result{like_or_empty(points, wanted & kPoints),
                         like_or_empty(centers, wanted & kCenters),
                         like_or_empty(scale_tril, wanted & kScaleTril),
                         like_or_empty(weights, wanted & kWeights)};
  k = std::min(k, count);
  if (k == 0 || n == 0) return result;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    using L = Layout<dim()>;
    const auto work = [&](const auto& engine) {
      const int64_t size = count * L::gradient;
      const int64_t parts =
          engine.parameters.packed.empty() ? parts_of(n, size * sizeof(T)) : 1;
      std::vector<T> sums((wanted & ~kPoints) ? size * parts : 0);
      visit_parts(engine, n, parts, [&](int64_t part) {
        return BackwardVisitor<T, dim()>{
            engine.positions, engine.parameters.shapes.data, in<T>(grad), probability, wanted,
            (wanted & kPoints) ? out<T>(std::get<0>(result)) : nullptr, sums.data() + part * size,
            {}};
      });
      if (wanted & ~kPoints)
        scatter_gradients<T, dim()>(
            engine.index.order, sums.data(), parts, count,
            (wanted & kWeights) ? out<T>(std::get<3>(result)) : nullptr,
            (wanted & kCenters) ? out<T>(std::get<1>(result)) : nullptr,
            (wanted & kScaleTril) ? out<T>(std::get<2>(result)) : nullptr);
    };
    with_engine<T, dim()>(points, centers, &scale_tril, &weights, k, index, work);
    return 0;
  });
  return result;
}

// Sums of the parts as tensors: counts, offsets, symmetric scatters.
template <class T, int D>
void scatter_moments(const int32_t* order, const std::vector<double>& sums, int64_t parts,
                     int64_t count, T* counts, T* offsets, T* scatters) {
  constexpr int kMoments = AssignVisitor<T, D>::kMoments;
  for (int64_t rank = 0; rank < count; ++rank) {
    double sum[kMoments] = {};
    for (int64_t part = 0; part < parts; ++part)
      for (int i = 0; i < kMoments; ++i) sum[i] += sums[(part * count + rank) * kMoments + i];
    const int64_t row = order[rank];
    counts[row] = T(sum[0]);
    for (int d = 0; d < D; ++d) offsets[row * D + d] = T(sum[1 + d]);
    const double* product = sum + 1 + D;
    for (int i = 0; scatters && i < D; ++i)
      for (int j = 0; j <= i; ++j, ++product)
        scatters[(row * D + i) * D + j] = scatters[(row * D + j) * D + i] = T(*product);
  }
}

Gradients assign(const Tensor& given_points, const Tensor& given_centers,
                 const Tensor& given_index, bool scatter) {
  const Tensor points = tidy(given_points), centers = tidy(given_centers);
  const Tensor index = usable_index(given_index);
  check_rows("points", points, centers);
  const int64_t count = centers.size(0), dim_size = centers.size(1), n = points.size(0);
  STD_TORCH_CHECK(count > 0, "centers must hold at least one row");
  const Gradients result{torch::stable::new_empty(points, {n}, ScalarType::Long),
                         torch::stable::new_zeros(points, {count}),
                         torch::stable::new_zeros(points, {count, dim_size}),
                         torch::stable::new_zeros(
                             points, {scatter ? count : 0, dim_size, dim_size})};
  if (n == 0) return result;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_engine<T, dim()>(points, centers, nullptr, nullptr, 1, index, [&](const auto& engine) {
      const int64_t size = count * AssignVisitor<T, dim()>::kMoments;
      const int64_t parts =
          engine.parameters.packed.empty() ? parts_of(n, size * sizeof(double)) : 1;
      std::vector<double> sums(size * parts);
      visit_parts(engine, n, parts, [&](int64_t part) {
        return AssignVisitor<T, dim()>{engine.index.order, engine.positions, scatter,
                                       out<int64_t>(std::get<0>(result)),
                                       sums.data() + part * size};
      });
      scatter_moments<T, dim()>(engine.index.order, sums, parts, count, out<T>(std::get<1>(result)),
                                out<T>(std::get<2>(result)),
                                scatter ? out<T>(std::get<3>(result)) : nullptr);
    });
    return 0;
  });
  return result;
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(lardhm, m) {
  m.def("build_index(Tensor centers, int k) -> Tensor");
  m.def("index_matches(Tensor index, Tensor centers, int k) -> bool");
  m.def("nearest(Tensor points, Tensor centers, int k, Tensor index) -> Tensor");
  m.def(
      "occupancy(Tensor points, Tensor centers, Tensor scale_tril, Tensor weights, int k, "
      "Tensor index, bool probability) -> Tensor");
  m.def(
      "occupancy_backward(Tensor grad, Tensor points, Tensor centers, Tensor scale_tril, "
      "Tensor weights, int k, Tensor index, bool probability, int wanted) "
      "-> (Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "assign(Tensor points, Tensor centers, Tensor index, bool scatter) "
      "-> (Tensor, Tensor, Tensor, Tensor)");
}

STABLE_TORCH_LIBRARY_IMPL(lardhm, CPU, m) {
  m.impl("build_index", TORCH_BOX(&build_index));
  m.impl("index_matches", TORCH_BOX(&index_matches));
  m.impl("nearest", TORCH_BOX(&nearest));
  m.impl("occupancy", TORCH_BOX(&occupancy));
  m.impl("occupancy_backward", TORCH_BOX(&occupancy_backward));
  m.impl("assign", TORCH_BOX(&assign));
}
