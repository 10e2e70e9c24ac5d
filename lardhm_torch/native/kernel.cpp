// LARD Hilbert map on the CPU: exact k nearest clusters, kernel and dot product in one pass.
//
//   log_odds(x) = sum over the k nearest centers c_m of w_m exp(-|inv(L_m) (x - c_m)|^2 / 2)
//
// Index: a table of equal cubes over the centers (root), each refined into an adaptive tree of 2^D
// children where centers are dense. A leaf lists every center that can be among the k nearest of a
// point inside it. Points are sorted by leaf; one vector register holds one packet of points of a
// leaf. Pass 1 streams the leaf's list past the packet and keeps the k-th smallest distance; pass 2
// evaluates the kernel of the few centers within it. Points outside the table, leaves with long
// lists and calls without a fitting index prune blocks of neighboring centers by the packet's box.
//
// Rows of the index are in rank order: the order of the centers along a Z curve.

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

template <class T>
inline T sum_lanes(typename Simd<T>::V v) {
  T lanes[Simd<T>::W];
  std::memcpy(lanes, &v, sizeof(v));
  for (int half = Simd<T>::W / 2; half > 0; half /= 2)
    for (int lane = 0; lane < half; ++lane) lanes[lane] += lanes[lane + half];
  return lanes[0];
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
  T coefficient = 1 / factorial;
  V y = coefficient - V{};
#pragma GCC unroll 16
  for (int i = C::terms; i > 0; --i) {
    coefficient *= i;
    y = y * rest + coefficient;
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

constexpr uint64_t kMagic = 0x3178656d6864724cULL;
constexpr int kBlock = 32;          // centers in a block of the pruned search
#ifndef TARGET
#define TARGET 28
#endif
constexpr int kTarget = TARGET;         // a leaf with at most this many candidates is not split
constexpr int kLongList = 192;      // leaves with more candidates use the pruned search
constexpr int kFinestBits = 20;     // cells along an axis at the finest level: 2^20
constexpr int32_t kUnset = std::numeric_limits<int32_t>::max();

struct Header {
  uint64_t magic, checksum;
  int64_t bytes, count, leaves, nodes, entries;
  int32_t dim, item_size, k, depth;  // depth: splits between the enclosing cube and a table cell
  int32_t grid[4];                   // table cells along each axis; all 0: no table
  double low[3];                     // corner of the table
  double side, margin;               // enclosing cube's edge; allowance for rounding [m]
};

uint64_t mix(uint64_t hash, uint64_t value) {
  hash ^= value + 0x9e3779b97f4a7c15ULL + (hash << 6) + (hash >> 2);
  hash *= 0xff51afd7ed558ccdULL;
  return hash ^ (hash >> 33);
}

uint64_t checksum(Header header) {
  header.checksum = 0;
  uint64_t words[sizeof(Header) / 8], hash = kMagic;
  static_assert(sizeof(Header) % 8 == 0, "the header is hashed in words");
  std::memcpy(words, &header, sizeof(header));
  for (uint64_t word : words) hash = mix(hash, word);
  return hash;
}

int64_t padded(int64_t count) { return (count + kBlock - 1) / kBlock * kBlock; }

struct Sections {
  int64_t centers, order, relative, boxes, root, nodes, leaves, entries, end;

  explicit Sections(const Header& h) {
    int64_t at = sizeof(Header);
    auto section = [&at](int64_t bytes) {
      const int64_t begin = (at + 63) / 64 * 64;
      at = begin + bytes;
      return begin;
    };
    const int64_t cells = int64_t(h.grid[0]) * h.grid[1] * (h.dim == 3 ? h.grid[2] : 1);
    centers = section(h.count * h.dim * h.item_size);
    order = section(h.count * 4);
    relative = section(padded(h.count) * h.dim * 4);
    boxes = section(padded(padded(h.count) / kBlock) * h.dim * 2 * 4);
    root = section(cells * 4);
    nodes = section(h.nodes * (1 << h.dim) * 4);
    leaves = section((h.leaves + 1) * 4);
    entries = section(h.entries * 4);
    end = (at + 63) / 64 * 64;
  }
};

struct Index {
  Header header;
  const int32_t* order;     // (M,) rank -> row of the centers
  const float* relative;    // (D, padded M) center - low, by rank; the padding is far away
  const float* boxes;       // (2, D, padded blocks) low and high corners of the blocks
  const int32_t* root;      // (cells,) leaf, or ~node
  const int32_t* nodes;     // (nodes, 2^D) leaf, or ~node
  const uint32_t* leaves;   // (leaves + 1,) where a leaf's list begins in entries
  const int32_t* entries;   // ranks, ascending in each list
  bool has_table() const { return header.grid[0] > 0; }
};

Index view_of(const char* bytes) {
  Index index;
  std::memcpy(&index.header, bytes, sizeof(Header));
  const Sections at(index.header);
  index.order = reinterpret_cast<const int32_t*>(bytes + at.order);
  index.relative = reinterpret_cast<const float*>(bytes + at.relative);
  index.boxes = reinterpret_cast<const float*>(bytes + at.boxes);
  index.root = reinterpret_cast<const int32_t*>(bytes + at.root);
  index.nodes = reinterpret_cast<const int32_t*>(bytes + at.nodes);
  index.leaves = reinterpret_cast<const uint32_t*>(bytes + at.leaves);
  index.entries = reinterpret_cast<const int32_t*>(bytes + at.entries);
  return index;
}

// Whether the bytes are an index of exactly these centers, good for k neighbors.
template <class T, int D>
bool matches(const char* bytes, int64_t size, const T* centers, int64_t count, int64_t k) {
  Header h;
  if (size < int64_t(sizeof(Header)) || reinterpret_cast<uintptr_t>(bytes) % 8 != 0) return false;
  std::memcpy(&h, bytes, sizeof(Header));
  if (h.magic != kMagic || h.bytes != size || h.checksum != checksum(h)) return false;
  if (h.count != count || h.dim != D || h.item_size != int(sizeof(T))) return false;
  if (h.k < std::min(k, count)) return false;
  const Sections at(h);
  if (at.end != size) return false;
  const auto* order = reinterpret_cast<const uint32_t*>(bytes + at.order);
  uint32_t largest = 0;
  for (int64_t i = 0; i < count; ++i) largest = std::max(largest, order[i]);
  return (count == 0 || largest < count) &&
         std::memcmp(bytes + at.centers, centers, sizeof(T) * D * count) == 0;
}

// ---------------------------------------------------------------------------------------------
// Building: where the table lies, rank order, blocks, then the tree from the top down.

template <class T, int D>
struct Frame {
  T low[D];
  float extent[D];
  double side;
  int32_t grid[4] = {1, 1, 1, 0};
  int32_t depth = 0;
};

// Table of about four cubes a center over the box of the centers, enlarged on every side.
template <class T, int D>
Frame<T, D> frame_of(const T* centers, int64_t count) {
  Frame<T, D> frame;
  T high[D];
  double largest = 0;
  for (int d = 0; d < D; ++d) {
    frame.low[d] = high[d] = count ? centers[d] : T(0);
    for (int64_t i = 1; i < count; ++i) {
      frame.low[d] = std::min(frame.low[d], centers[i * D + d]);
      high[d] = std::max(high[d], centers[i * D + d]);
    }
    largest = std::max(largest, double(high[d]) - double(frame.low[d]));
  }
  if (!(largest > 0)) largest = 1;
  double volume = 1, extent[D];
  for (int d = 0; d < D; ++d) {
    const double enlarged = double(frame.low[d]) - 0.06 * largest;
    frame.low[d] = T(enlarged);
    extent[d] = double(high[d]) + 0.06 * largest - double(frame.low[d]);
    frame.extent[d] = float(extent[d]);
    volume *= extent[d];
  }
  const double cells = std::min(std::max<double>(4.0 * count, 64.0), 2097152.0);
  const double edge = std::pow(volume / cells, 1.0 / D);
  if (!(edge > 1e-30 * largest) || !std::isfinite(largest)) {
    frame.side = std::numeric_limits<double>::infinity();
    return frame;
  }
  int64_t most = 1;
  for (int d = 0; d < D; ++d) {
    frame.grid[d] = int32_t(std::ceil(extent[d] / edge));
    most = std::max<int64_t>(most, frame.grid[d]);
  }
  while ((int64_t(1) << frame.depth) < most) ++frame.depth;
  frame.side = edge * double(int64_t(1) << frame.depth);
  return frame;
}

template <int D>
uint64_t z_curve(const float* relative, const float* scale) {
  uint64_t code = 0;
  for (int d = 0; d < D; ++d) {
    uint64_t cell = uint64_t(std::min(std::max(relative[d] * scale[d], 0.0f), 65535.0f));
    for (int bit = 0; bit < 16; ++bit) code |= ((cell >> bit) & 1) << (bit * D + d);
  }
  return code;
}

template <class T, int D>
std::vector<int32_t> rank_order(const T* centers, int64_t count, const Frame<T, D>& frame) {
  std::vector<std::pair<uint64_t, int32_t>> keys(count);
  float scale[D], relative[D];
  for (int d = 0; d < D; ++d) scale[d] = float(65536.0 / frame.side);
  for (int64_t i = 0; i < count; ++i) {
    for (int d = 0; d < D; ++d) relative[d] = float(centers[i * D + d] - frame.low[d]);
    keys[i] = {z_curve<D>(relative, scale), int32_t(i)};
  }
  std::sort(keys.begin(), keys.end());
  std::vector<int32_t> order(count);
  for (int64_t rank = 0; rank < count; ++rank) order[rank] = keys[rank].second;
  return order;
}

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

struct Cell {
  int32_t level;
  int32_t at[3];
};

struct Fill {
  Cell cell;
  int32_t entry;
};

// Leaves and nodes of some part of the tree; entries of `fills` name table cells they cover.
struct Part {
  std::vector<Fill> fills;
  std::vector<int32_t> nodes;
  std::vector<uint32_t> lengths;
  std::vector<int32_t> entries;
};

template <int D>
struct TreeBuilder {
  static constexpr int C = 1 << D;
  using V = typename Vectors<float, C * 4>::V;
  using I = typename Vectors<float, C * 4>::I;
  using FarthestFn = I (*)(const TreeBuilder&, const Cell&, const int32_t*, int64_t, I*);

  const float* relative;
  int64_t stride;
  Header header;
  FarthestFn bound;
  int64_t budget;  // entries a part may hold before it stops splitting

  double edge(int level) const { return header.side / double(int64_t(1) << level); }

  // The 2^D children's distances to the candidates: nearest points' (squared, as bits) are stored,
  // the k-th smallest of the farthest points' is returned: no child needs more distant centers.
  template <int K>
  static I children_bound(const TreeBuilder& b, const Cell& cell, const int32_t* list, int64_t n,
                          I* nearest) {
    const float half = float(b.edge(cell.level + 2) + b.header.margin);
    V middle[D];
    for (int d = 0; d < D; ++d)
      for (int c = 0; c < C; ++c)
        middle[d][c] = float((2 * cell.at[d] + ((c >> (D - 1 - d)) & 1) + 0.5) *
                             b.edge(cell.level + 1));
    Smallest<I, K> smallest(b.header.k);
    for (int64_t i = 0; i < n; ++i) {
      V near2 = {}, far2 = {};
      for (int d = 0; d < D; ++d) {
        const V offset = b.relative[d * b.stride + list[i]] - middle[d];
        const V distance = (V)((I)offset & 0x7fffffff);
        const V inside = distance - half;
        const V outside = (V)((I)inside & ~((I)inside >> 31));
        near2 += outside * outside;
        far2 += (distance + half) * (distance + half);
      }
      nearest[i] = (I)near2;
      smallest.insert((I)far2);
    }
    const V kth = (V)smallest.last() * 1.00001f;
    return (I)kth;
  }

  static FarthestFn bound_for(int k) {
#define LARDHM_USE(K) return &children_bound<K>
    LARDHM_FOR_K(k, LARDHM_USE)
#undef LARDHM_USE
  }

  // Candidate lists of the children of a cell, each in `lists` with room for n.
  void split(const Cell& cell, const int32_t* list, int64_t n, std::vector<int32_t>* lists) const {
    std::unique_ptr<I[]> nearest(new I[n]);
    const I kth = bound(*this, cell, list, n, nearest.get());
    int32_t* out[C];
    int64_t length[C] = {};
    for (int c = 0; c < C; ++c) {
      lists[c].resize(n);
      out[c] = lists[c].data();
    }
    for (int64_t i = 0; i < n; ++i) {
      const uint32_t keep = bits_le<I>(nearest[i], kth);
      for (int c = 0; c < C; ++c) {
        out[c][length[c]] = list[i];
        length[c] += (keep >> c) & 1;
      }
    }
    for (int c = 0; c < C; ++c) lists[c].resize(length[c]);
  }

  Cell child(const Cell& cell, int c) const {
    Cell inner{cell.level + 1, {0, 0, 0}};
    for (int d = 0; d < D; ++d) inner.at[d] = 2 * cell.at[d] + ((c >> (D - 1 - d)) & 1);
    return inner;
  }

  bool in_table(const Cell& cell) const {
    const int shift = header.depth - cell.level;
    for (int d = 0; d < D; ++d)
      if (shift >= 0 && (int64_t(cell.at[d]) << shift) >= header.grid[d]) return false;
    return true;
  }

  bool is_leaf(const Cell& cell, int64_t n, const Part& part) const {
    return n <= std::max<int64_t>(kTarget, header.k) || cell.level >= kFinestBits ||
           int64_t(part.entries.size()) > budget;
  }

  static int32_t add_leaf(Part& part, const std::vector<int32_t>& list) {
    part.entries.insert(part.entries.end(), list.begin(), list.end());
    part.lengths.push_back(uint32_t(list.size()));
    return int32_t(part.lengths.size()) - 1;
  }

  // The entry of a cell at or below the table's level; a fill for each cell above it.
  int32_t grow(const Cell& cell, const std::vector<int32_t>& list, Part& part) const {
    const bool above = cell.level < header.depth;
    int32_t entry = kUnset;
    std::vector<int32_t> lists[C];
    bool leaf = is_leaf(cell, list.size(), part);
    if (!leaf) {
      split(cell, list.data(), list.size(), lists);
      int64_t total = 0;
      for (int c = 0; c < C; ++c) total += lists[c].size();
      leaf = !above && total > int64_t(0.85 * C * list.size());
    }
    if (leaf) {
      entry = add_leaf(part, list);
    } else if (above) {
      for (int c = 0; c < C; ++c)
        if (in_table(child(cell, c))) grow(child(cell, c), lists[c], part);
      return kUnset;
    } else {
      const int64_t node = part.nodes.size() / C;
      part.nodes.resize(part.nodes.size() + C);
      for (int c = 0; c < C; ++c) {
        const int32_t inner = grow(child(cell, c), lists[c], part);
        part.nodes[node * C + c] = inner;
      }
      entry = ~int32_t(node);
    }
    if (cell.level <= header.depth) part.fills.push_back({cell, entry});
    return entry;
  }
};

// Table cells named by the fills; `leaves` and `nodes` are how many came in earlier parts.
template <int D>
void fill_table(const Header& h, const Part& part, int64_t leaves, int64_t nodes, int32_t* root) {
  for (const Fill& fill : part.fills) {
    const int shift = h.depth - fill.cell.level;
    const int32_t entry =
        fill.entry >= 0 ? int32_t(fill.entry + leaves) : int32_t(fill.entry - nodes);
    int64_t begin[3] = {0, 0, 0}, end[3] = {1, 1, 1};
    for (int d = 0; d < D; ++d) {
      begin[d] = int64_t(fill.cell.at[d]) << shift;
      end[d] = std::min<int64_t>(begin[d] + (int64_t(1) << shift), h.grid[d]);
    }
    const int64_t inner = D == 3 ? h.grid[2] : 1;
    for (int64_t x = begin[0]; x < end[0]; ++x)
      for (int64_t y = begin[1]; y < end[1]; ++y)
        for (int64_t z = begin[2]; z < end[2]; ++z)
          root[(x * h.grid[1] + y) * inner + z] = entry;
  }
}

template <class T, int D>
struct IndexBuilder {
  Header header{};
  Frame<T, D> frame;
  const T* centers;
  std::vector<int32_t> order;
  std::vector<float> relative;
  std::vector<Part> parts;

  // with_tree = false: rank order and blocks alone, enough for the pruned search.
  IndexBuilder(const T* centers_, int64_t count, int64_t k, bool with_tree) : centers(centers_) {
    frame = frame_of<T, D>(centers, count);
    header.magic = kMagic;
    header.count = count;
    header.dim = D;
    header.item_size = sizeof(T);
    header.k = int32_t(std::min(k, count));
    header.depth = frame.depth;
    header.side = frame.side;
    header.margin = frame.side * std::ldexp(1.0, -20);
    for (int d = 0; d < D; ++d) header.low[d] = double(frame.low[d]);
    order = rank_order<T, D>(centers, count, frame);
    fill_relative();
    if (!with_tree || count == 0 || !std::isfinite(frame.side)) return;
    for (int d = 0; d < D; ++d) header.grid[d] = frame.grid[d];
    grow_tree();
  }

  void fill_relative() {
    const int64_t stride = padded(header.count);
    relative.assign(stride * D, std::numeric_limits<float>::max());
    for (int d = 0; d < D; ++d)
      for (int64_t rank = 0; rank < header.count; ++rank) {
        const float x = float(centers[int64_t(order[rank]) * D + d] - frame.low[d]);
        if (std::isfinite(x)) relative[d * stride + rank] = x;
      }
  }

  // The upper levels on one thread, then each of their cells as a part of its own.
  void grow_tree() {
    const int64_t budget = std::max<int64_t>(int64_t(1) << 20, 512 * header.count);
    TreeBuilder<D> tree{relative.data(), padded(header.count), header,
                        TreeBuilder<D>::bound_for(header.k), budget};
    std::vector<std::pair<Cell, std::vector<int32_t>>> cells(1);
    cells[0].first = Cell{0, {0, 0, 0}};
    for (int64_t rank = 0; rank < header.count; ++rank)
      cells[0].second.push_back(int32_t(rank));
    const int serial_levels = header.count > 2000 ? std::min(header.depth, 6 / D) : 0;
    for (int level = 0; level < serial_levels; ++level) {
      std::vector<std::pair<Cell, std::vector<int32_t>>> inner;
      for (auto& [cell, list] : cells) {
        std::vector<int32_t> lists[TreeBuilder<D>::C];
        tree.split(cell, list.data(), list.size(), lists);
        for (int c = 0; c < TreeBuilder<D>::C; ++c)
          if (tree.in_table(tree.child(cell, c)))
            inner.emplace_back(tree.child(cell, c), std::move(lists[c]));
      }
      cells = std::move(inner);
    }
    parts.resize(cells.size());
    run_tasks(cells.size(),
              [&](int64_t i) { tree.grow(cells[i].first, cells[i].second, parts[i]); });
    for (const Part& part : parts) {
      header.leaves += part.lengths.size();
      header.nodes += part.nodes.size() / TreeBuilder<D>::C;
      header.entries += part.entries.size();
    }
  }

  int64_t bytes() const { return Sections(header).end; }

  void write(char* to) {
    const Sections at(header);
    header.bytes = at.end;
    header.checksum = checksum(header);
    std::memcpy(to, &header, sizeof(Header));
    std::memcpy(to + at.centers, centers, sizeof(T) * D * header.count);
    std::memcpy(to + at.order, order.data(), 4 * order.size());
    std::memcpy(to + at.relative, relative.data(), 4 * relative.size());
    write_boxes(reinterpret_cast<float*>(to + at.boxes));
    write_tree(to, at);
  }

  void write_boxes(float* boxes) const {
    const int64_t stride = padded(header.count), blocks = stride / kBlock;
    for (int64_t d = 0; d < D; ++d)
      for (int64_t block = 0; block < padded(blocks); ++block) {
        float low = std::numeric_limits<float>::max(), high = low;
        const int64_t begin = block * kBlock, end = std::min(begin + kBlock, header.count);
        for (int64_t rank = begin; rank < end; ++rank) {
          const float x = relative[d * stride + rank];
          low = std::min(low, x);
          high = rank == begin ? x : std::max(high, x);
        }
        boxes[d * padded(blocks) + block] = low;
        boxes[(D + d) * padded(blocks) + block] = high;
      }
  }

  void write_tree(char* to, const Sections& at) const {
    auto* root = reinterpret_cast<int32_t*>(to + at.root);
    auto* nodes = reinterpret_cast<int32_t*>(to + at.nodes);
    auto* starts = reinterpret_cast<uint32_t*>(to + at.leaves);
    auto* entries = reinterpret_cast<int32_t*>(to + at.entries);
    int64_t leaves = 0, inner = 0;
    uint32_t filled = 0;
    for (const Part& part : parts) {
      fill_table<D>(header, part, leaves, inner, root);
      for (int32_t entry : part.nodes)
        *nodes++ = entry >= 0 ? int32_t(entry + leaves) : int32_t(entry - inner);
      std::copy(part.entries.begin(), part.entries.end(), entries + filled);
      for (uint32_t length : part.lengths) {
        *starts++ = filled;
        filled += length;
      }
      leaves += part.lengths.size();
      inner += part.nodes.size() / TreeBuilder<D>::C;
    }
    *starts = filled;
  }
};

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

constexpr int64_t kPackGrain = 8192;

// Centers by rank; a center that is not finite is farther than any other.
template <class T, int D>
void pack_positions(const Index& index, const T* centers, AlignedArray<T>& positions) {
  const int64_t count = index.header.count;
  positions.allocate(count * Layout<D>::position);
  run_tasks((count + kPackGrain - 1) / kPackGrain, [&](int64_t task) {
    const int64_t end = std::min(count, (task + 1) * kPackGrain);
    for (int64_t rank = task * kPackGrain; rank < end; ++rank) {
      const T* center = centers + int64_t(index.order[rank]) * D;
      T* to = positions.data + rank * Layout<D>::position;
      bool finite = true;
      for (int d = 0; d < D; ++d) finite = finite && std::isfinite(center[d]);
      for (int d = 0; d < Layout<D>::position; ++d)
        to[d] = d >= D ? T(0) : finite ? center[d] : std::numeric_limits<T>::infinity();
    }
  });
}

template <class T, int D>
void pack_shapes(const Index& index, const T* scale_tril, const T* weights,
                 AlignedArray<T>& shapes) {
  using L = Layout<D>;
  const int64_t count = index.header.count;
  shapes.allocate(count * L::shape);
  run_tasks((count + kPackGrain - 1) / kPackGrain, [&](int64_t task) {
    const int64_t end = std::min(count, (task + 1) * kPackGrain);
    for (int64_t rank = task * kPackGrain; rank < end; ++rank) {
      const int64_t row = index.order[rank];
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
  });
}

// ---------------------------------------------------------------------------------------------
// Packets: points of one leaf, one a lane.

template <class T, int D>
struct Packet {
  using V = typename Simd<T>::V;
  V x[D];
  int64_t row[Simd<T>::W];
  int lanes;
};

// The clusters some lane of a packet selected; bits tell which lanes.
template <class T>
struct Selection {
  std::vector<int32_t> rank;
  std::vector<uint32_t> bits;
  int64_t size = 0;

  void reserve(int64_t n) {
    if (int64_t(rank.size()) < n) {
      rank.resize(2 * n);
      bits.resize(2 * n);
    }
  }
};

// Squared distances of the packet to the listed centers (as bits, in `distance`); their k-th
// smallest, lane by lane.
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
      squared = d == 0 ? offset * offset : squared + offset * offset;
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

// What one thread needs while it works through points.
template <class T, int D>
struct Scratch {
  using I = typename Simd<T>::I;
  std::vector<int32_t> leaf, order, other, list;
  std::vector<uint32_t> histogram;
  AlignedArray<I> distance;
  int64_t room = 0;
  Selection<T> selected;

  void reserve_list(int64_t n) {
    if (n <= room) return;
    room = 2 * n;
    distance.allocate(room);
    selected.reserve(room);
  }
};

template <class T, int D>
struct Engine {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  using Int = typename Simd<T>::Int;
  static constexpr int W = Simd<T>::W;

  Index index;
  const T* points;
  const T* positions;
  int k;
  KthFn<T, D> kth;
  T low[D];
  float scale;  // finest cells a meter
  std::atomic<bool>* broken;

  Engine(const Index& index_, const T* points_, const T* positions_, int64_t k_,
         std::atomic<bool>* broken_)
      : index(index_), points(points_), positions(positions_), k(int(k_)),
        kth(kth_distance_for<T, D>(int(k_))), broken(broken_) {
    for (int d = 0; d < D; ++d) low[d] = T(index.header.low[d]);
    scale = float(double(1 << kFinestBits) / index.header.side);
  }

  int32_t outside() const { return int32_t(index.header.leaves); }
  int32_t invalid() const { return outside() + 1; }
  int32_t buckets() const { return outside() + 2; }

  // Leaf of each of the points begin .. end.
  void locate(int64_t begin, int64_t end, int32_t* leaf) const {
    const int shift = kFinestBits - index.header.depth;
    float limit[D];
    for (int d = 0; d < D; ++d)
      limit[d] = index.has_table() ? float(int64_t(index.header.grid[d]) << shift) : 0.0f;
    for (int64_t first = begin; first < end; first += 16) {
      const int n = int(std::min<int64_t>(16, end - first));
      int32_t cell[D][16], inside[16], table[16];
      for (int j = 0; j < 16; ++j) inside[j] = 1, table[j] = 0;
      for (int d = 0; d < D; ++d) {
        float at[16];
        for (int j = 0; j < n; ++j)
          at[j] = float(points[(first + j) * D + d] - low[d]) * scale;
        for (int j = n; j < 16; ++j) at[j] = 0;
        for (int j = 0; j < 16; ++j) {
          const int32_t in = (at[j] >= 0.0f) & (at[j] < limit[d]);
          inside[j] &= in;
          cell[d][j] = int32_t(in ? at[j] : 0.0f);
          table[j] = table[j] * index.header.grid[d] + (cell[d][j] >> shift);
        }
      }
      for (int j = 0; j < n; ++j) {
        if (!inside[j]) {
          leaf[first - begin + j] = finite(first + j) ? outside() : invalid();
          continue;
        }
        int32_t entry = index.root[table[j]];
        for (int down = shift - 1; entry < 0; --down) {
          int child = 0;
          for (int d = 0; d < D; ++d) child = 2 * child + ((cell[d][j] >> down) & 1);
          entry = descend(~entry, child, down);
        }
        leaf[first - begin + j] = std::min(entry, outside());
      }
    }
  }

  int32_t descend(int32_t node, int child, int down) const {
    if (node >= index.header.nodes || down < 0) return outside();
    return index.nodes[int64_t(node) * (1 << D) + child];
  }

  bool finite(int64_t row) const {
    T sum = 0;
    for (int d = 0; d < D; ++d) sum += points[row * D + d] * T(0);
    return sum == T(0);
  }

  // One counting pass over a digit of the leaf numbers: from -> to, stable.
  void counting_pass(const int32_t* leaf, const int32_t* from, int32_t* to, int64_t n, int shift,
                     uint32_t mask, std::vector<uint32_t>& histogram) const {
    histogram.assign(int64_t(mask) + 2, 0);
    for (int64_t i = 0; i < n; ++i) ++histogram[((uint32_t(leaf[i]) >> shift) & mask) + 1];
    for (int64_t digit = 0; digit < int64_t(mask); ++digit) histogram[digit + 1] += histogram[digit];
    for (int64_t i = 0; i < n; ++i) {
      const int32_t point = from ? from[i] : int32_t(i);
      to[histogram[(uint32_t(leaf[point]) >> shift) & mask]++] = point;
    }
  }

  void sort_by_leaf(int64_t n, Scratch<T, D>& s) const {
    int bits = 1;
    while ((int64_t(1) << bits) < buckets()) ++bits;
    s.order.resize(n);
    if (bits <= 12 || (int64_t(1) << bits) <= n / 8) {
      counting_pass(s.leaf.data(), nullptr, s.order.data(), n, 0, (1u << bits) - 1, s.histogram);
      return;
    }
    s.other.resize(n);
    const int low_bits = (bits + 1) / 2;
    counting_pass(s.leaf.data(), nullptr, s.other.data(), n, 0, (1u << low_bits) - 1, s.histogram);
    counting_pass(s.leaf.data(), s.other.data(), s.order.data(), n, low_bits,
                  (1u << (bits - low_bits)) - 1, s.histogram);
  }

  // Up to W points; the last one again in lanes that are left over.
  void gather(int64_t begin, const int32_t* order, int lanes, Packet<T, D>& packet) const {
    T x[D][W];
    for (int lane = 0; lane < W; ++lane) {
      const int64_t row = begin + order[std::min(lane, lanes - 1)];
      packet.row[lane] = row;
      for (int d = 0; d < D; ++d) x[d][lane] = points[row * D + d];
    }
    for (int d = 0; d < D; ++d) packet.x[d] = load<V>(x[d]);
    packet.lanes = lanes;
  }

  // Fills s.selected with the k nearest of the listed centers, lane by lane; ties go to the lower
  // row of the centers.
  void select(const Packet<T, D>& packet, const int32_t* list, int64_t n, Scratch<T, D>& s) const {
    const I limit = kth(packet, positions, list, n, k, s.distance.data);
    const uint32_t all = packet.lanes == 32 ? ~0u : (1u << packet.lanes) - 1;
    Selection<T>& selected = s.selected;
    int64_t size = 0, total = 0;
    for (int64_t i = 0; i < n; ++i) {
      const uint32_t bits = bits_le<I>(s.distance.data[i], limit) & all;
      selected.rank[size] = int32_t(i);
      selected.bits[size] = bits;
      size += bits != 0;
      total += __builtin_popcount(bits);
    }
    selected.size = size;
    if (total != int64_t(packet.lanes) * k) break_ties(packet.lanes, limit, list, s);
    for (int64_t j = 0; j < size; ++j) selected.rank[j] = list[selected.rank[j]];
  }

  // Of the candidates at exactly the k-th distance of a lane, keeps those of the lowest rows.
  void break_ties(int lanes, I limit, const int32_t* list, Scratch<T, D>& s) const {
    Selection<T>& selected = s.selected;
    std::vector<std::pair<int32_t, int64_t>> tied;
    for (int lane = 0; lane < lanes; ++lane) {
      int nearer = 0;
      tied.clear();
      for (int64_t j = 0; j < selected.size; ++j) {
        if (!((selected.bits[j] >> lane) & 1)) continue;
        if (s.distance.data[selected.rank[j]][lane] < limit[lane])
          ++nearer;
        else
          tied.emplace_back(index.order[list[selected.rank[j]]], j);
      }
      if (nearer + int(tied.size()) <= k) continue;
      std::sort(tied.begin(), tied.end());
      for (size_t i = size_t(k - nearer); i < tied.size(); ++i)
        selected.bits[tied[i].second] &= ~(1u << lane);
    }
  }

  // Every center that can be among the k nearest of a point in the packet, by blocks: exact
  // anywhere in space.
  void prune(const Packet<T, D>& packet, Scratch<T, D>& s) const {
    float box_low[D], box_high[D], largest = float(index.header.side);
    for (int d = 0; d < D; ++d) {
      box_low[d] = std::numeric_limits<float>::infinity();
      box_high[d] = -box_low[d];
      for (int lane = 0; lane < packet.lanes; ++lane) {
        const float x = float(packet.x[d][lane] - low[d]);
        box_low[d] = std::min(box_low[d], x);
        box_high[d] = std::max(box_high[d], x);
        largest = std::max(largest, std::abs(x));
      }
    }
    const float margin = largest * std::ldexp(1.0f, -20);
    const int64_t count = index.header.count, blocks = padded(count) / kBlock;
    const int64_t stride = padded(blocks), full = count / kBlock;
    std::vector<float>& far = farthest_buffer();
    far.resize(std::max(full, padded(count)));
    for (int64_t block = 0; block < full; ++block) far[block] = block_far(box_low, box_high, block, stride);
    const float bound = enlarged(kth_of(far, full, (k + kBlock - 1) / kBlock), margin);
    s.list.clear();
    for (int64_t block = 0; block < blocks; ++block) {
      if (block_near(box_low, box_high, block, stride) > bound) continue;
      for (int64_t rank = block * kBlock; rank < std::min(count, (block + 1) * kBlock); ++rank)
        s.list.push_back(int32_t(rank));
    }
    tighten(box_low, box_high, margin, s, far);
  }

  static std::vector<float>& farthest_buffer() {
    static thread_local std::vector<float> buffer;
    return buffer;
  }

  static float kth_of(std::vector<float>& values, int64_t n, int64_t kth) {
    if (n < kth) return std::numeric_limits<float>::infinity();
    std::nth_element(values.begin(), values.begin() + (kth - 1), values.begin() + n);
    return values[kth - 1];
  }

  // A squared distance with the allowance for rounding of the coordinates.
  static float enlarged(float squared, float margin) {
    const float distance = std::sqrt(squared) + 4 * margin;
    return distance * distance * 1.00001f;
  }

  float block_far(const float* box_low, const float* box_high, int64_t block,
                  int64_t stride) const {
    float sum = 0;
    for (int d = 0; d < D; ++d) {
      const float a = index.boxes[(D + d) * stride + block] - box_low[d];
      const float b = box_high[d] - index.boxes[d * stride + block];
      const float far = std::max(a, b);
      sum += far * far;
    }
    return sum;
  }

  float block_near(const float* box_low, const float* box_high, int64_t block,
                   int64_t stride) const {
    float sum = 0;
    for (int d = 0; d < D; ++d) {
      const float a = index.boxes[d * stride + block] - box_high[d];
      const float b = box_low[d] - index.boxes[(D + d) * stride + block];
      const float near = std::max(std::max(a, b), 0.0f);
      sum += near * near;
    }
    return sum;
  }

  // Keeps of s.list the centers nearer to the box than the k-th smallest farthest distance.
  void tighten(const float* box_low, const float* box_high, float margin, Scratch<T, D>& s,
               std::vector<float>& far) const {
    const int64_t stride = padded(index.header.count), n = s.list.size();
    std::vector<float> near(n);
    for (int64_t i = 0; i < n; ++i) {
      float near2 = 0, far2 = 0;
      for (int d = 0; d < D; ++d) {
        const float a = index.relative[d * stride + s.list[i]] - box_high[d];
        const float b = box_low[d] - index.relative[d * stride + s.list[i]];
        const float inner = std::max(std::max(a, b), 0.0f), outer = std::min(a, b);
        near2 += inner * inner;
        far2 += outer * outer;
      }
      near[i] = near2;
      far[i] = far2;
    }
    const float bound = enlarged(kth_of(far, n, k), margin);
    int64_t kept = 0;
    for (int64_t i = 0; i < n; ++i) {
      s.list[kept] = s.list[i];
      kept += !(near[i] > bound);
    }
    s.list.resize(kept);
  }

  // Shows the visitor the points begin .. end: packet by packet with s.selected filled in, or one
  // by one where a coordinate is not finite.
  template <class Visitor>
  void visit(int64_t begin, int64_t end, Scratch<T, D>& s, Visitor& visitor) const {
    const int64_t n = end - begin;
    s.leaf.resize(n);
    locate(begin, end, s.leaf.data());
    sort_by_leaf(n, s);
    Packet<T, D> packet;
    for (int64_t i = 0; i < n;) {
      const int32_t leaf = s.leaf[s.order[i]];
      if (leaf == invalid()) {
        visitor.invalid(begin + s.order[i++]);
        continue;
      }
      int64_t stop = i + 1;
      while (stop < n && s.leaf[s.order[stop]] == leaf) ++stop;
      visit_leaf(leaf, begin, i, stop, packet, s, visitor);
      i = stop;
    }
  }

  template <class Visitor>
  void visit_leaf(int32_t leaf, int64_t begin, int64_t i, int64_t stop, Packet<T, D>& packet,
                  Scratch<T, D>& s, Visitor& visitor) const {
    const int32_t* list = nullptr;
    int64_t length = 0;
    if (leaf != outside()) list = leaf_list(leaf, length);
    if (length <= kLongList && list) s.reserve_list(length);
    for (; i < stop; i += W) {
      gather(begin, s.order.data() + i, int(std::min<int64_t>(W, stop - i)), packet);
      if (!list || length > kLongList) {
        prune(packet, s);
        s.reserve_list(s.list.size());
        select(packet, s.list.data(), s.list.size(), s);
      } else {
        select(packet, list, length, s);
      }
      visitor.packet(packet, s.selected);
    }
  }

  // The list of a leaf; null, with `broken` set, where the index holds rubbish.
  const int32_t* leaf_list(int32_t leaf, int64_t& length) const {
    const int64_t from = index.leaves[leaf], to = index.leaves[leaf + 1];
    bool good = from <= to && to <= index.header.entries && to - from >= k;
    uint32_t largest = 0;
    for (int64_t i = from; good && i < to; ++i)
      largest = std::max(largest, uint32_t(index.entries[i]));
    good = good && int64_t(largest) < index.header.count;
    if (!good) broken->store(true);
    length = good ? to - from : 0;
    return good ? index.entries + from : nullptr;
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

template <class T>
inline void store_rows(typename Simd<T>::V value, const int64_t* row, int lanes, T* to) {
  T lane_value[Simd<T>::W];
  std::memcpy(lane_value, &value, sizeof(value));
  for (int lane = 0; lane < lanes; ++lane) to[row[lane]] = lane_value[lane];
}

template <class T, int D>
struct OccupancyVisitor {
  using V = typename Simd<T>::V;
  const T *positions, *shapes;
  bool probability;
  T* out;

  void invalid(int64_t row) { out[row] = std::numeric_limits<T>::quiet_NaN(); }

  void packet(const Packet<T, D>& packet, const Selection<T>& selected) {
    using L = Layout<D>;
    V sum = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      V z[D];
      whiten<T, D>(packet, positions + int64_t(selected.rank[j]) * L::position, shape, z);
      const V term = kernel_of<T, D>(z) * shape[L::weight];
      sum = mask_of<T>(selected.bits[j]) ? sum + term : sum;
    }
    store_rows<T>(probability ? sigmoid<T>(sum) : sum, packet.row, packet.lanes, out);
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

  void packet(const Packet<T, D>& packet, const Selection<T>& selected) {
    int64_t filled[Simd<T>::W] = {};
    for (int64_t j = 0; j < selected.size; ++j)
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        insert(out + packet.row[lane] * k, filled[lane]++, order[selected.rank[j]]);
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

  void packet(const Packet<T, D>& packet, const Selection<T>& selected) {
    bytes.resize((selected.size + 1) * (D + 1) * sizeof(V) + 64);
    V* terms = reinterpret_cast<V*>((reinterpret_cast<uintptr_t>(bytes.data()) + 63) / 64 * 64);
    const V g = incoming(packet, selected, terms);
    V towards[D] = {};
    for (int64_t j = 0; j < selected.size; ++j)
      cluster(selected.rank[j], g, terms + j * (D + 1), towards);
    if (!(wanted & kPoints)) return;
    for (int lane = 0; lane < packet.lanes; ++lane)
      for (int d = 0; d < D; ++d) grad_points[packet.row[lane] * D + d] = -towards[d][lane];
  }

  // Gradient that reaches the log-odds; the terms of a cluster are z and the masked kernel value.
  V incoming(const Packet<T, D>& packet, const Selection<T>& selected, V* terms) const {
    V sum = {}, g = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      V* z = terms + j * (D + 1);
      whiten<T, D>(packet, positions + int64_t(selected.rank[j]) * L::position, shape, z);
      z[D] = mask_of<T>(selected.bits[j]) ? kernel_of<T, D>(z) : V{};
      sum += z[D] * shape[L::weight];
    }
    for (int lane = 0; lane < packet.lanes; ++lane) g[lane] = grad[packet.row[lane]];
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

  void packet(const Packet<T, D>& packet, const Selection<T>& selected) {
    for (int64_t j = 0; j < selected.size; ++j) {
      const int64_t rank = selected.rank[j];
      const T* center = positions + rank * Layout<D>::position;
      for (uint32_t bits = selected.bits[j]; bits; bits &= bits - 1) {
        const int lane = __builtin_ctz(bits);
        labels[packet.row[lane]] = order[rank];
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

constexpr int64_t kCoherentBlock = 32768;
constexpr int64_t kScatteredBlock = int64_t(1) << 19;

// An index for the call: the one given where it fits, else one of its own.
template <class T, int D>
struct CallIndex {
  AlignedArray<char> own;
  Index index;

  CallIndex(const Tensor* given, const T* centers, int64_t count, int64_t k, int64_t num_points) {
    if (given && given->numel() > 0) {
      const char* bytes = static_cast<const char*>(given->const_data_ptr());
      if (matches<T, D>(bytes, given->numel(), centers, count, k)) {
        index = view_of(bytes);
        return;
      }
    }
    build(centers, count, k, num_points > count);
  }

  void build(const T* centers, int64_t count, int64_t k, bool with_tree) {
    IndexBuilder<T, D> builder(centers, count, k, with_tree);
    own.allocate(builder.bytes());
    builder.write(own.data);
    index = view_of(own.data);
  }
};

// Points that follow each other share leaves: lattices and scans do, shuffled points do not.
template <class T, int D>
bool is_coherent(const Engine<T, D>& engine, int64_t n) {
  constexpr int64_t kSample = 1024;
  if (n < 8 * kSample) return false;
  std::vector<int32_t> leaf(kSample);
  int64_t distinct = 0;
  for (int64_t sample = 0; sample < 4; ++sample) {
    const int64_t begin = (n - kSample) / 3 * sample;
    engine.locate(begin, begin + kSample, leaf.data());
    std::sort(leaf.begin(), leaf.end());
    distinct += std::unique(leaf.begin(), leaf.end()) - leaf.begin();
  }
  return distinct < kSample;
}

template <class T, int D>
int64_t block_size(const Engine<T, D>& engine, int64_t n, int64_t workers) {
  const int64_t share = std::max<int64_t>((n + workers - 1) / workers, 256);
  return std::min(share, is_coherent(engine, n) ? kCoherentBlock : kScatteredBlock);
}

// Runs a copy of the visitor over blocks of points, on all threads.
template <class T, int D, class Visitor>
void visit_all(const Engine<T, D>& engine, int64_t n, const Visitor& visitor) {
  if (n == 0) return;
  const int64_t block = block_size(engine, n, num_threads());
  const int64_t blocks = (n + block - 1) / block;
  std::atomic<int64_t> next{0};
  run_tasks(std::min(blocks, num_threads()), [&](int64_t) {
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

// Runs `work(engine, positions)` with an index that fits, again with a fresh one if it was damaged.
template <class T, int D, class Work>
void with_engine(const Tensor& points, const Tensor& centers, int64_t k, const Tensor& given,
                 const Work& work) {
  const int64_t count = centers.size(0);
  CallIndex<T, D> call(&given, in<T>(centers), count, k, points.size(0));
  std::atomic<bool> broken{false};
  AlignedArray<T> positions;
  for (int attempt = 0; attempt < 2; ++attempt) {
    if (attempt == 1) call.build(in<T>(centers), count, k, true);
    pack_positions<T, D>(call.index, in<T>(centers), positions);
    const Engine<T, D> engine(call.index, in<T>(points), positions.data, k, &broken);
    work(engine, positions.data);
    if (!broken) return;
  }
}

Tensor build_index(const Tensor& given_centers, int64_t k) {
  check_k(k);
  const Tensor centers = tidy(given_centers);
  return dispatch(centers, [&](auto type, auto dim) {
    IndexBuilder<decltype(type), dim()> builder(in<decltype(type)>(centers), centers.size(0), k,
                                                true);
    const Tensor index =
        torch::stable::new_empty(centers, {builder.bytes()}, ScalarType::Byte);
    builder.write(out<char>(index));
    return index;
  });
}

bool index_matches(const Tensor& index, const Tensor& given_centers, int64_t k) {
  check_k(k);
  if (index.scalar_type() != ScalarType::Byte || !index.is_contiguous()) return false;
  const Tensor centers = tidy(given_centers);
  return dispatch(centers, [&](auto type, auto dim) {
    return index.numel() > 0 && matches<decltype(type), dim()>(in<char>(index), index.numel(),
                                                   in<decltype(type)>(centers), centers.size(0), k);
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
    with_engine<T, dim()>(points, centers, k, index, [&](const auto& engine, const T*) {
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
    with_engine<T, dim()>(points, centers, k, index, [&](const auto& engine, const T* positions) {
      AlignedArray<T> shapes;
      pack_shapes<T, dim()>(engine.index, in<T>(scale_tril), in<T>(weights), shapes);
      visit_all(engine, points.size(0),
                OccupancyVisitor<T, dim()>{positions, shapes.data, probability, out<T>(values)});
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
    with_engine<T, dim()>(points, centers, k, index, [&](const auto& engine, const T* positions) {
      AlignedArray<T> shapes;
      pack_shapes<T, dim()>(engine.index, in<T>(scale_tril), in<T>(weights), shapes);
      const int64_t size = count * L::gradient;
      const int64_t parts = parts_of(n, size * sizeof(T));
      std::vector<T> sums((wanted & ~kPoints) ? size * parts : 0);
      visit_parts(engine, n, parts, [&](int64_t part) {
        return BackwardVisitor<T, dim()>{positions, shapes.data, in<T>(grad), probability, wanted,
                                         (wanted & kPoints) ? out<T>(std::get<0>(result)) : nullptr,
                                         sums.data() + part * size, {}};
      });
      if (wanted & ~kPoints)
        scatter_gradients<T, dim()>(
            engine.index.order, sums.data(), parts, count,
            (wanted & kWeights) ? out<T>(std::get<3>(result)) : nullptr,
            (wanted & kCenters) ? out<T>(std::get<1>(result)) : nullptr,
            (wanted & kScaleTril) ? out<T>(std::get<2>(result)) : nullptr);
    });
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
                         torch::stable::new_zeros(points, {scatter ? count : 0, dim_size, dim_size})};
  if (n == 0) return result;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_engine<T, dim()>(points, centers, 1, index, [&](const auto& engine, const T* positions) {
      const int64_t size = count * AssignVisitor<T, dim()>::kMoments;
      const int64_t parts = parts_of(n, size * sizeof(double));
      std::vector<double> sums(size * parts);
      visit_parts(engine, n, parts, [&](int64_t part) {
        return AssignVisitor<T, dim()>{engine.index.order, positions, scatter,
                                       out<int64_t>(std::get<0>(result)), sums.data() + part * size};
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

STABLE_TORCH_LIBRARY(lardhm, m) {
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
