// Sums of affine functions of the neighbors, weighted by the features or their fourth powers
// (`features.mixture`).

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "kernel.h"
#include "search.h"
#include "tensors.h"

namespace lardhm {
namespace {

constexpr int kColumns = 16;  // of the table, summed at a time

template <class T, int D>
struct MixtureVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  const int32_t* order;
  const T *positions, *shapes, *table;
  const char* used;  // rows of the table that are not 0
  int64_t columns, width;  // width: 1, or 1 + D with the gradients
  bool sharp;
  T* out;

  MixtureVisitor(const Parameters<T, D>& parameters, const T* table_, const char* used_,
                 int64_t columns_, int64_t width_, bool sharp_, T* out_)
      : order(parameters.index.order), positions(parameters.positions.data),
        shapes(parameters.shapes.data), table(table_), used(used_), columns(columns_),
        width(width_), sharp(sharp_), out(out_) {}

  void invalid(int64_t row) override {
    std::fill_n(out + row * columns, columns, std::numeric_limits<T>::quiet_NaN());
  }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    for (int64_t first = 0; first < columns; first += kColumns)
      add(packet, selected, first, int(std::min<int64_t>(kColumns, columns - first)));
  }

  void add(const Packet<T, D>& packet, const Selection& selected, int64_t first, int count) const {
    V sums[kColumns] = {};
    for (int64_t j = 0; j < selected.size; ++j) {
      const int64_t rank = selected.rank[j], row = order[rank];
      if (!used[row]) continue;
      const T* center = positions + rank * Layout<D>::position;
      V value = feature_of<T, D>(packet, center, shapes + rank * Layout<D>::shape);
      if (sharp) value *= value, value *= value;
      value = mask_of<T>(selected.bits[j]) ? value : V{};
      const T* entries = table + (row * columns + first) * width;
      if (width == 1) {
        for (int c = 0; c < count; ++c) sums[c] += value * entries[c];
        continue;
      }
      V offset[D];
      for (int d = 0; d < D; ++d) offset[d] = value * (packet.x[d] - center[d]);
      for (int c = 0; c < count; ++c, entries += 1 + D) {
        sums[c] += value * entries[0];
        for (int d = 0; d < D; ++d) sums[c] += offset[d] * entries[1 + d];
      }
    }
    T lanes[Simd<T>::W];
    for (int c = 0; c < count; ++c) {
      std::memcpy(lanes, &sums[c], sizeof(lanes));
      for (int lane = 0; lane < packet.lanes; ++lane)
        out[packet.row(lane) * columns + first + c] = lanes[lane];
    }
  }
};

Tensor mixture(const Tensor& given_points, const Tensor& centers, const Tensor& raw,
               const Tensor& given_table, int64_t k, double covariance_scale,
               double min_lengthscale, const Tensor& index, bool sharp) {
  check_k(k);
  const Tensor points = tidy(given_points), table = tidy(given_table);
  check_rows("points", points, centers);
  check(table.dim() == 3 && table.size(0) == centers.size(0) &&
            (table.size(2) == 1 || table.size(2) == 1 + centers.size(1)) &&
            table.scalar_type() == centers.scalar_type(),
        "table must be (M, C, 1) or (M, C, 1 + D) for M centers, of their dtype");
  const Tensor weights = new_zeros(centers, {centers.size(0)});
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  k = std::min(k, centers.size(0));
  const int64_t n = points.size(0), columns = table.size(1), width = table.size(2);
  const Tensor sums = new_zeros(points, {n, columns});
  if (k == 0 || columns == 0) return sums;
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    const T* entries = in<T>(table);
    std::vector<char> used(table.size(0));
    for (int64_t row = 0; row < table.size(0); ++row)
      used[row] = std::any_of(entries + row * columns * width, entries + (row + 1) * columns * width,
                              [](T entry) { return entry != 0; });
    with_parameters<T, dim()>(map, n, [&](Parameters<T, dim()>& parameters) {
      MixtureVisitor<T, dim()> visitor(parameters, entries, used.data(), columns, width, sharp,
                                       out<T>(sums));
      visit_all<T, dim()>(in<T>(points), n, parameters, k, visitor);
    });
    return 0;
  });
  return sums;
}

}  // namespace

std::vector<Operator> mixture_operators() {
  return {
      {"mixture(Tensor points, Tensor centers, Tensor raw_scale_tril, Tensor table, int k, "
       "float covariance_scale, float min_lengthscale, Tensor index, bool sharp) -> Tensor",
       &boxed<mixture>},
  };
}

}  // namespace lardhm
