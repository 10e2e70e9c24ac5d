// One point of each cell of a lattice, see `thinning.one_per_cell`.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "priority.h"
#include "tensors.h"

namespace lardhm {
namespace {

constexpr double kFarthest = 1e15;  // as thinning.FARTHEST

int64_t cell_number(double number) {
  return number <= kFarthest ? int64_t(std::max(number, -kFarthest)) : int64_t(kFarthest);
}

// Hash of a point's cell and group. Two cells of 10^6 agree in it once in 10^7 sets.
template <class T, int D>
uint64_t cell_of(const T* point, int64_t group, T edge) {
  uint64_t mixed = 0;
  const auto mix = [&mixed](int64_t word) {
    mixed = (mixed ^ uint64_t(word)) * 0x9E3779B97F4A7C15ull;
    mixed ^= mixed >> 32;
  };
  for (int d = 0; d < D; ++d) mix(cell_number(double(std::floor(point[d] / edge))));
  mix(group);
  return mixed;
}

// The row that each cell has chosen: a table with linear probing.
class Chosen {
  struct Entry {
    uint64_t cell;
    uint32_t rank;
    int32_t row;
  };
  std::vector<Entry> table;
  uint64_t last;

 public:
  std::vector<char> is_chosen;  // by row
  int64_t count = 0;

  explicit Chosen(int64_t size) : is_chosen(size, 0) {
    uint64_t room = 16;
    while (room < 2 * uint64_t(size)) room *= 2;
    table.assign(room, Entry{0, 0, -1});
    last = room - 1;
  }

  void offer(uint64_t cell, uint32_t rank, int32_t row) {
    uint64_t at = cell & last;
    while (table[at].row >= 0 && table[at].cell != cell) at = (at + 1) & last;
    if (table[at].row >= 0 && table[at].rank <= rank) return;
    if (table[at].row < 0)
      ++count;
    else
      is_chosen[table[at].row] = 0;
    is_chosen[row] = 1;
    table[at] = {cell, rank, row};
  }
};

Tensor one_per_cell(const Tensor& given_points, const Tensor& given_groups, double edge) {
  const Tensor points = tidy(given_points), groups = tidy(given_groups);
  check(edge > 0, "edge must be > 0");
  check(points.dim() == 2 && groups.scalar_type() == ScalarType::Long &&
            groups.numel() == points.size(0),
        "groups must be (N,) int64, one per point");
  const int64_t n = points.size(0);
  Chosen chosen(n);
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    for (int64_t i = 0; i < n; ++i) {
      const T* point = in<T>(points) + i * D;
      chosen.offer(cell_of<T, D>(point, in<int64_t>(groups)[i], T(edge)),
                   priority<T, D>(point, kCellPriorities), int32_t(i));
    }
    return 0;
  });
  const Tensor rows = new_empty(points, {chosen.count}, ScalarType::Long);
  int64_t* to = out<int64_t>(rows);
  for (int64_t i = 0; i < n; ++i)
    if (chosen.is_chosen[i]) *to++ = i;
  return rows;
}

}  // namespace

std::vector<Operator> thinning_operators() {
  return {
      {"one_per_cell(Tensor points, Tensor groups, float edge) -> Tensor", &boxed<one_per_cell>},
  };
}

}  // namespace lardhm
