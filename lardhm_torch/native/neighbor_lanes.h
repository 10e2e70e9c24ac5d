// The kernels of one point and their gradients: its neighbors are the lanes of registers.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "kernel.h"

namespace lardhm {
namespace tuning {

// Columns of the table of parameters: weight, center, lower factor row by row.
template <int D>
constexpr int kColumns = 1 + D + D * (D + 1) / 2;

// A cluster in the memory of the gradient: center, 1 / diagonal, below the diagonal, weight.
template <int D>
struct Record {
  static constexpr int inverse = D, below = 2 * D, weight = below + D * (D - 1) / 2;
  static constexpr int fields = weight + 1, stride = 16;  // stride: of gradients, too
};

// Fields of a point's neighbors, then their gradients: a row of lanes each.
template <class T, int D>
struct Lanes {
  using V = typename Simd<T>::V;
  static constexpr int W = Simd<T>::W;
  int64_t k, rows;
  std::vector<V> memory;
  V *fields, *grads, *squared, *kernel, *z;
  std::vector<V> exists;  // 1 in lanes of neighbors

  explicit Lanes(int64_t k_) : k(k_), rows((k_ + W - 1) / W) {
    constexpr int kFields = Record<D>::fields, kGrads = kColumns<D>;
    memory.assign(rows * (kFields + kGrads + 2 + D), V{});
    fields = memory.data();
    grads = fields + rows * kFields;
    squared = grads + rows * kGrads;
    kernel = squared + rows;
    z = kernel + rows;
    exists.assign(rows, V{});
    for (int64_t j = 0; j < k; ++j) lane(exists.data(), j) = 1;
  }

  static T& lane(V* row, int64_t j) { return reinterpret_cast<T*>(row)[j]; }

  void read(const int32_t* index, const T* records) {
    V block[W];
    for (int64_t r = 0; r < rows; ++r)
      for (int c = 0; c < Record<D>::fields; c += W) {
        for (int j = 0; j < W; ++j) {
          const int64_t neighbor = std::min<int64_t>(r * W + j, k - 1);
          block[j] = load<V>(records + int64_t(index[neighbor]) * Record<D>::stride + c);
        }
        transpose<T>(block);
        for (int f = c; f < std::min(Record<D>::fields, c + W); ++f)
          fields[f * rows + r] = block[f - c];
      }
  }

  void add_to(const int32_t* index, T* sums) const {
    V block[W];
    for (int64_t r = 0; r < rows; ++r)
      for (int c = 0; c < kColumns<D>; c += W) {
        for (int g = 0; g < W; ++g)
          block[g] = c + g < kColumns<D> ? grads[(c + g) * rows + r] : V{};
        transpose<T>(block);
        for (int64_t j = r * W; j < std::min(k, (r + 1) * W); ++j) {
          T* sum = sums + int64_t(index[j]) * Record<D>::stride + c;
          const V total = load<V>(sum) + block[j - r * W];
          std::memcpy(sum, &total, sizeof(V));
        }
      }
  }

  // Whitened offsets, kernel values and squared distances; returns the largest of the latter.
  T forward(const T* x) {
    V most = {};
    for (int64_t r = 0; r < rows; ++r) {
      V offset[D], zr[D], shape[Record<D>::fields - D], sum = {};
      for (int d = 0; d < D; ++d) offset[d] = x[d] - fields[d * rows + r];
      for (int f = D; f < Record<D>::fields; ++f) shape[f - D] = fields[f * rows + r];
      for (int d = 0; d < D; ++d) sum += offset[d] * offset[d];
      whiten_offset<T, D>(offset, shape, zr);
      squared[r] = sum * exists[r];
      for (int d = 0; d < D; ++d) z[d * rows + r] = zr[d];
      kernel[r] = kernel_of<T, D>(zr) * exists[r];
      most = squared[r] > most ? squared[r] : most;
    }
    return -smallest_lane<T>(-most);
  }

  T log_odds(T fading, bool fades) const {
    V sum = {};
    for (int64_t r = 0; r < rows; ++r) {
      const V fade = fades ? fade_of<T>(squared[r] * fading) : V{} + T(1);
      sum += kernel[r] * fade * fields[Record<D>::weight * rows + r];
    }
    return sum_lanes<T>(sum);
  }

  void write_values(T fading, bool fades, T* to) const {
    for (int64_t r = 0; r < rows; ++r) {
      const V fade = fades ? fade_of<T>(squared[r] * fading) : V{} + T(1);
      const V value = kernel[r] * fade;
      std::memcpy(to + r * W, &value, std::min<int64_t>(W, k - r * W) * sizeof(T));
    }
  }

  // Gradients of weight, center and factor; `pull` is that of the log-odds.
  void backward(const T* x, T pull, T farthest, T fading, bool fades) {
    V reach = {}, tied = {};
    for (int64_t r = 0; r < rows; ++r) {
      const V t = squared[r] * fading, weight = fields[Record<D>::weight * rows + r];
      const V value = kernel[r] * (fades ? fade_of<T>(t) : V{} + T(1));
      grads[r] = pull * value;
      const V share = pull * weight * value;
      const V slope = fades ? pull * weight * kernel[r] * fade_slope<T>(t) * fading : V{};
      reach -= slope * t;
      tied += squared[r] >= farthest ? exists[r] : V{};
      shape_gradient(x, r, share, T(2) * slope);
    }
    if (!fades) return;
    const T pulled = T(2) * sum_lanes<T>(reach) / sum_lanes<T>(tied);
    for (int64_t r = 0; r < rows; ++r) {
      const V at_it = squared[r] >= farthest ? exists[r] * pulled : V{};
      for (int d = 0; d < D; ++d)
        grads[(1 + d) * rows + r] += at_it * (fields[d * rows + r] - x[d]);
    }
  }

  // y = inv(L)^T z; d log_odds / dc = w phi y, by L: w phi y z^T; the fade adds 2 slope (c - x).
  void shape_gradient(const T* x, int64_t r, V share, V slope) {
    const auto field = [&](int f) { return fields[f * rows + r]; };
    V y[D], zr[D];
    for (int d = 0; d < D; ++d) zr[d] = z[d * rows + r];
    y[D - 1] = share * zr[D - 1] * field(Record<D>::inverse + D - 1);
    if constexpr (D == 3)
      y[1] = (share * zr[1] - y[2] * field(Record<D>::below + 2)) * field(Record<D>::inverse + 1);
    y[0] = share * zr[0] - y[1] * field(Record<D>::below);
    if constexpr (D == 3) y[0] -= y[2] * field(Record<D>::below + 1);
    y[0] *= field(Record<D>::inverse);
    for (int d = 0; d < D; ++d)
      grads[(1 + d) * rows + r] = y[d] + slope * (field(d) - x[d]);
    V* factor = grads + (1 + D) * rows + r;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j <= i; ++j, factor += rows) *factor = y[i] * zr[j];
  }
};

}  // namespace tuning
}  // namespace lardhm
