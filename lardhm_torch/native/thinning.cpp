// Cells of a lattice that hold points: a few points of each (`thinning.few_per_cell`), and their number.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
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

// Numbers for cells, in the order in which they appear: a table with linear probing.
class Numbers {
  struct Entry {
    uint64_t cell;
    int32_t number;
  };
  std::vector<Entry> table;
  uint64_t last;

 public:
  int32_t count = 0;

  explicit Numbers(int64_t most) {
    uint64_t room = 16;
    while (room < 2 * uint64_t(most)) room *= 2;
    table.assign(room, Entry{0, -1});
    last = room - 1;
  }

  int32_t of(uint64_t cell) {
    uint64_t at = (cell * 0x9E3779B97F4A7C15ull) >> 20 & last;
    while (table[at].number >= 0 && table[at].cell != cell) at = (at + 1) & last;
    if (table[at].number < 0) table[at] = {cell, count++};
    return table[at].number;
  }
};

// Clears the marks of all but `most` rows of a cell, those of smallest priority.
template <class T, int D>
void choose(const T* points, const int32_t* rows, int64_t n, int64_t most,
            std::vector<std::pair<uint32_t, int32_t>>& ranked, std::vector<char>& is_chosen) {
  if (n <= most) return;
  ranked.clear();
  for (int64_t i = 0; i < n; ++i)
    ranked.emplace_back(priority<T, D>(points + int64_t(rows[i]) * D, kCellPriorities), rows[i]);
  std::nth_element(ranked.begin(), ranked.begin() + most, ranked.end());
  for (int64_t i = most; i < n; ++i) is_chosen[ranked[i].second] = 0;
}

template <class T, int D>
std::vector<char> chosen_rows(const T* points, const int64_t* groups, int64_t n, T edge,
                              int64_t most) {
  Numbers numbers(n);
  std::vector<int32_t> owners(n), rows(n);
  for (int64_t i = 0; i < n; ++i)
    owners[i] = numbers.of(cell_of<T, D>(points + i * D, groups[i], edge));
  std::vector<int32_t> first(numbers.count + 2, 0);  // shifted by one while the rows are placed
  for (int32_t owner : owners) ++first[owner + 2];
  for (int32_t m = 0; m < numbers.count; ++m) first[m + 2] += first[m + 1];
  for (int64_t i = 0; i < n; ++i) rows[first[owners[i] + 1]++] = int32_t(i);
  std::vector<char> is_chosen(n, 1);
  std::vector<std::pair<uint32_t, int32_t>> ranked;
  for (int32_t m = 0; m < numbers.count; ++m)
    choose<T, D>(points, rows.data() + first[m], first[m + 1] - first[m], most, ranked, is_chosen);
  return is_chosen;
}

Tensor few_per_cell(const Tensor& given_points, const Tensor& given_groups, double edge,
                    int64_t most) {
  const Tensor points = tidy(given_points), groups = tidy(given_groups);
  check(edge > 0 && most > 0, "edge and most must be > 0");
  check(points.dim() == 2 && groups.scalar_type() == ScalarType::Long &&
            groups.numel() == points.size(0),
        "groups must be (N,) int64, one per point");
  const int64_t n = points.size(0);
  std::vector<char> is_chosen;
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    is_chosen = chosen_rows<T, dim()>(in<T>(points), in<int64_t>(groups), n, T(edge), most);
    return 0;
  });
  const Tensor rows = new_empty(
      points, {int64_t(std::count(is_chosen.begin(), is_chosen.end(), 1))}, ScalarType::Long);
  int64_t* to = out<int64_t>(rows);
  for (int64_t i = 0; i < n; ++i)
    if (is_chosen[i]) *to++ = i;
  return rows;
}

// Number of cells of a lattice that hold points.
int64_t count_cells(const Tensor& given_points, double edge) {
  const Tensor points = tidy(given_points);
  check(edge > 0, "edge must be > 0");
  int64_t count = 0;
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const int64_t n = points.size(0);
    Numbers cells(n);
    uint64_t before = 0;
    for (int64_t i = 0; i < n; ++i) {
      uint64_t key = 0;
      for (int d = D - 1; d >= 0; --d)
        key = (key << 21) + uint64_t(int64_t(std::floor(in<T>(points)[i * D + d] / T(edge))));
      if (i && key == before) continue;
      cells.of(before = key);
    }
    count = cells.count;
    return 0;
  });
  return count;
}

}  // namespace

std::vector<Operator> thinning_operators() {
  return {
      {"count_cells(Tensor points, float edge) -> int", &boxed<count_cells>},
      {"few_per_cell(Tensor points, Tensor groups, float edge, int most) -> Tensor",
       &boxed<few_per_cell>},
  };
}

}  // namespace lardhm
