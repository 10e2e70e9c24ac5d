// Moments of points about the centers they belong to, summed in parts.

#pragma once

#include <cstdint>
#include <vector>

namespace lardhm {

// Count, offsets, lower triangle of their products.
template <int D>
constexpr int kMoments = 1 + D + D * (D + 1) / 2;

template <class T, int D>
void add_moments(const T* offset, bool scatter, double* to) {
  to[0] += 1;
  for (int d = 0; d < D; ++d) to[1 + d] += offset[d];
  if (!scatter) return;
  double* product = to + 1 + D;
  for (int i = 0; i < D; ++i)
    for (int j = 0; j <= i; ++j) *product++ += double(offset[i]) * double(offset[j]);
}

// One row of moments for each part and rank of a center.
template <int D>
struct MomentParts {
  int64_t count, parts;
  std::vector<double> sums;

  MomentParts(int64_t count_, int64_t parts_)
      : count(count_), parts(parts_), sums(count_ * parts_ * kMoments<D>) {}

  double* part(int64_t number) { return sums.data() + number * count * kMoments<D>; }

  // The first `moments` of one center, over all parts.
  void total(int64_t rank, int moments, double* sum) const {
    for (int i = 0; i < moments; ++i) sum[i] = 0;
    for (int64_t part = 0; part < parts; ++part)
      for (int i = 0; i < moments; ++i) sum[i] += sums[(part * count + rank) * kMoments<D> + i];
  }

  // As rows of tensors: counts, offsets and optionally symmetric scatters.
  template <class T>
  void write(const int32_t* order, T* counts, T* offsets, T* scatters) const {
    for (int64_t rank = 0; rank < count; ++rank) {
      double sum[kMoments<D>];
      total(rank, kMoments<D>, sum);
      const int64_t row = order[rank];
      counts[row] = T(sum[0]);
      for (int d = 0; d < D; ++d) offsets[row * D + d] = T(sum[1 + d]);
      const double* product = sum + 1 + D;
      for (int i = 0; scatters && i < D; ++i)
        for (int j = 0; j <= i; ++j, ++product)
          scatters[(row * D + i) * D + j] = scatters[(row * D + j) * D + i] = T(*product);
    }
  }
};

}  // namespace lardhm
