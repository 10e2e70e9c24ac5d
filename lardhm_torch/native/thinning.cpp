// Cells of a lattice that hold points: a few points of each (`thinning.few_per_cell`), and their number.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "priority.h"
#include "tensors.h"
#include "threads.h"

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

// Rows by the cell that they lie in: `cells` sorted into buckets that a thread handles in its cache.
// All rows of a cell are in one bucket, ascending.
struct Buckets {
  static constexpr int64_t kRows = 2048, kMost = 1 << 12;  // in a bucket, about; number of buckets
  int64_t count = 1;
  std::vector<int64_t> first;  // of each bucket, in `rows`
  std::vector<int32_t> rows;

  explicit Buckets(const std::vector<uint64_t>& cells) : rows(cells.size()) {
    while (count < kMost && count * kRows < int64_t(cells.size())) count *= 2;
    first.assign(count + 2, 0);  // shifted by one while the rows are placed
    for (uint64_t cell : cells) ++first[of(cell) + 2];
    for (int64_t b = 0; b < count; ++b) first[b + 2] += first[b + 1];
    for (size_t i = 0; i < cells.size(); ++i) rows[first[of(cells[i]) + 1]++] = int32_t(i);
  }

  int64_t of(uint64_t cell) const { return int64_t((cell * 0x9E3779B97F4A7C15ull) >> 52) & (count - 1); }
};

// Numbers for the cells of a bucket, in the order in which they appear: a table with linear probing.
class Numbers {
  struct Entry {
    uint64_t cell;
    int32_t number;
  };
  std::vector<Entry> table;
  uint64_t last = 0;

 public:
  int32_t count = 0;

  void clear(int64_t most) {
    uint64_t room = 16;
    while (room < 2 * uint64_t(most)) room *= 2;
    table.assign(room, Entry{0, -1});
    last = room - 1;
    count = 0;
  }

  int32_t of(uint64_t cell) {
    uint64_t at = (cell * 0x9E3779B97F4A7C15ull) >> 20 & last;
    while (table[at].number >= 0 && table[at].cell != cell) at = (at + 1) & last;
    if (table[at].number < 0) table[at] = {cell, count++};
    return table[at].number;
  }
};

// Cell numbers of the rows of a bucket, and these rows cell by cell.
struct Bucket {
  Numbers numbers;
  std::vector<int32_t> owners, first, rows;
  std::vector<std::pair<uint32_t, int32_t>> ranked;

  void divide(const std::vector<uint64_t>& cells, const int32_t* given, int64_t n) {
    numbers.clear(n);
    owners.resize(n);
    rows.resize(n);
    for (int64_t i = 0; i < n; ++i) owners[i] = numbers.of(cells[given[i]]);
    first.assign(numbers.count + 2, 0);  // shifted by one while the rows are placed
    for (int32_t owner : owners) ++first[owner + 2];
    for (int32_t m = 0; m < numbers.count; ++m) first[m + 2] += first[m + 1];
    for (int64_t i = 0; i < n; ++i) rows[first[owners[i] + 1]++] = given[i];
  }
};

// Clears the marks of all but `most` rows of a cell, those of smallest priority.
template <class T, int D>
void choose(const T* points, const int32_t* rows, int64_t n, int64_t most,
            std::vector<std::pair<uint32_t, int32_t>>& ranked, char* is_chosen) {
  if (n <= most) return;
  ranked.clear();
  for (int64_t i = 0; i < n; ++i)
    ranked.emplace_back(priority<T, D>(points + int64_t(rows[i]) * D, kCellPriorities), rows[i]);
  std::nth_element(ranked.begin(), ranked.begin() + most, ranked.end());
  for (int64_t i = most; i < n; ++i) is_chosen[ranked[i].second] = 0;
}

// cell(i) of each row.
template <class Cell>
std::vector<uint64_t> cells_of(int64_t n, const Cell& cell) {
  constexpr int64_t kTogether = 4096;
  std::vector<uint64_t> cells(n);
  run_tasks((n + kTogether - 1) / kTogether, [&](int64_t task) {
    const int64_t end = std::min(n, (task + 1) * kTogether);
    for (int64_t i = task * kTogether; i < end; ++i) cells[i] = cell(i);
  });
  return cells;
}

template <class T, int D>
std::vector<char> chosen_rows(const T* points, const int64_t* groups, int64_t n, T edge,
                              int64_t most) {
  const auto cells =
      cells_of(n, [&](int64_t i) { return cell_of<T, D>(points + i * D, groups[i], edge); });
  const Buckets buckets(cells);
  std::vector<char> is_chosen(n, 1);
  run_tasks(buckets.count, [&](int64_t b) {
    Bucket own;
    own.divide(cells, buckets.rows.data() + buckets.first[b],
               buckets.first[b + 1] - buckets.first[b]);
    for (int32_t m = 0; m < own.numbers.count; ++m)
      choose<T, D>(points, own.rows.data() + own.first[m], own.first[m + 1] - own.first[m], most,
                   own.ranked, is_chosen.data());
  });
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
  std::atomic<int64_t> count{0};
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const T* from = in<T>(points);
    const auto cells = cells_of(points.size(0), [&](int64_t i) {
      uint64_t key = 0;
      for (int d = D - 1; d >= 0; --d)
        key = (key << 21) + uint64_t(int64_t(std::floor(from[i * D + d] / T(edge))));
      return key;
    });
    const Buckets buckets(cells);
    run_tasks(buckets.count, [&](int64_t b) {
      Numbers numbers;
      const int64_t first = buckets.first[b], end = buckets.first[b + 1];
      numbers.clear(end - first);
      for (int64_t i = first; i < end; ++i) numbers.of(cells[buckets.rows[i]]);
      count += numbers.count;
    });
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
