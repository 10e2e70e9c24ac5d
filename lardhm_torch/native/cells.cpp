// Cells of space that rays pass through: a hash table with one bit per cell, as in
// `crossings.unmarked_cells`.

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstring>
#include <vector>

#include "candidates.h"
#include "tensors.h"
#include "threads.h"

namespace lardhm {
namespace {

constexpr int kTableBits = 24;                                  // as crossings.TABLE_BITS
constexpr int kGlanceBits = 22;                                 // 512 KB
constexpr int kBlockBits = 17;                                  // 16 KB
constexpr int kBlockShift = kWide == 4 ? 3 : kWide == 8 ? 4 : 5;  // a block is 2 kWide cells wide
constexpr uint32_t kPrimes[3] = {73856093, 19349669, 83492791};  // as crossings.PRIMES
constexpr int64_t kRaysPerTask = 256, kPointsPerTask = 8192;

// A power of two of bits; larger indices wrap around.
class Bits {
  std::vector<std::atomic<uint32_t>> words;
  uint32_t last;

 public:
  explicit Bits(int bits) : words(size_t(1) << (bits - 5)), last((uint32_t(1) << bits) - 1) {}

  bool has(uint32_t entry) const {
    return words[(entry & last) >> 5].load(std::memory_order_relaxed) >> (entry & 31) & 1;
  }

  void mark(uint32_t entry) {
    if (!has(entry))
      words[(entry & last) >> 5].fetch_or(1u << (entry & 31), std::memory_order_relaxed);
  }
};

constexpr uint32_t kEntries = (uint32_t(1) << kTableBits) - 1;

// Table entry of a cell. Only the low bits matter, so cell indices may wrap around.
template <int D>
uint32_t entry_of(const int64_t* cell) {
  uint32_t entry = 0;
  for (int d = 0; d < D; ++d) entry ^= uint32_t(cell[d]) * kPrimes[d];
  return entry & kEntries;
}

// Rays mark only entries that belong to some point. These are few: most steps along a ray end after a
// look at a small table, of single cells or of blocks of them, which is not written while rays are
// followed.
struct Table {
  Bits blocks{kBlockBits}, glance{kGlanceBits}, asked{kTableBits}, crossed{kTableBits};

  // Also marks the blocks in which the middle of kWide steps along a ray lies if one is in the cell.
  template <int D>
  void ask(const int64_t* cell) {
    const uint32_t entry = entry_of<D>(cell);
    if (asked.has(entry)) return;
    glance.mark(entry);
    asked.mark(entry);
    for (int corner = 0; corner < 1 << D; ++corner) {
      uint32_t block = 0;
      for (int d = 0; d < D; ++d) {
        const int32_t at = int32_t(uint32_t(cell[d]) + (corner >> d & 1 ? kWide / 2 : -kWide / 2));
        block ^= uint32_t(at >> kBlockShift) * kPrimes[d];
      }
      blocks.mark(block);
    }
  }

  void cross(uint32_t entry) {
    if (asked.has(entry)) crossed.mark(entry);
  }
};

using Unsigned = uint32_t __attribute__((vector_size(kRegisterBytes)));

inline Unsigned whole_cells(Wide x) {
  const WideInt toward_zero = __builtin_convertvector(x, WideInt);
  return (Unsigned)(toward_zero + (__builtin_convertvector(toward_zero, Wide) > x));
}

// A ray from its start: a cell and the place inside it.
template <int D>
struct Way {
  const int64_t* cell;
  const float *inside, *way;

  // Numbers of the cells so far along the ray, in units of a cell.
  void cells(Wide along, Unsigned* found) const {
    for (int d = 0; d < D; ++d)
      found[d] = whole_cells(inside[d] + rounded(along * way[d])) + uint32_t(cell[d]);
  }
};

// The lanes of `some` whose entries have a bit.
inline uint32_t marked(const Bits& bits, Unsigned entry, uint32_t some) {
  uint32_t entries[kWide], found = 0;
  std::memcpy(entries, &entry, sizeof(entries));
  for (int j = 0; j < kWide; ++j) found |= uint32_t(bits.has(entries[j])) << j;
  return found & some;
}

// Marks the cells at half a cell, one and a half, ... along a ray.
template <int D>
void march(const Way<D>& ray, int64_t steps, Table& table) {
  Wide lane;
  for (int j = 0; j < kWide; ++j) lane[j] = float(j);
  Unsigned cells[D];
  for (int64_t first = 0; first < steps; first += kWide * kWide) {
    ray.cells(float(first) + (lane + 0.5f) * float(kWide), cells);  // middles of kWide steps each
    Unsigned block = {};
    for (int d = 0; d < D; ++d)
      block ^= (Unsigned)((WideInt)cells[d] >> kBlockShift) * kPrimes[d];
    uint32_t runs = existing(0, (steps - first + kWide - 1) / kWide);
    for (runs = marked(table.blocks, block, runs); runs; runs &= runs - 1) {
      const int64_t step = first + kWide * __builtin_ctz(runs);
      ray.cells(float(step) + (lane + 0.5f), cells);
      Unsigned entry = {};
      for (int d = 0; d < D; ++d) entry ^= cells[d] * kPrimes[d];
      entry &= kEntries;
      uint32_t some = marked(table.glance, entry, existing(0, steps - step));
      for (; some; some &= some - 1) table.cross(entry[__builtin_ctz(some)]);
    }
  }
}

struct Rays {
  const int64_t *cells, *steps;
  const float *inside, *ways;
  int64_t count;
  bool one_start;
};

template <int D>
void march_all(const Rays& rays, Table& table) {
  run_tasks((rays.count + kRaysPerTask - 1) / kRaysPerTask, [&](int64_t task) {
    const int64_t stop = std::min(rays.count, (task + 1) * kRaysPerTask);
    for (int64_t ray = task * kRaysPerTask; ray < stop; ++ray) {
      const int64_t start = rays.one_start ? 0 : ray * D;
      const Way<D> way{rays.cells + start, rays.inside + start, rays.ways + ray * D};
      march<D>(way, rays.steps[ray], table);
    }
  });
}

template <int D>
void look_up(const int64_t* cells, int64_t n, const Table& table, bool* unmarked) {
  run_tasks((n + kPointsPerTask - 1) / kPointsPerTask, [&](int64_t task) {
    const int64_t stop = std::min(n, (task + 1) * kPointsPerTask);
    for (int64_t row = task * kPointsPerTask; row < stop; ++row)
      unmarked[row] = !table.crossed.has(entry_of<D>(cells + row * D));
  });
}

void check_rays(const Tensor& cells, const Tensor& inside, const Tensor& ways,
                const Tensor& steps) {
  check(cells.scalar_type() == ScalarType::Long && steps.scalar_type() == ScalarType::Long &&
            inside.scalar_type() == ScalarType::Float && ways.scalar_type() == ScalarType::Float,
        "cells and steps must be int64, places in cells and ways float32");
  check(ways.dim() == 2 && (ways.size(1) == 2 || ways.size(1) == 3),
        "ways must be (R, 2) or (R, 3)");
  const int64_t rays = ways.size(0), dim = ways.size(1);
  check(cells.dim() == 2 && cells.size(1) == dim && inside.dim() == 2 && inside.size(1) == dim &&
            inside.size(0) == cells.size(0) && (cells.size(0) == 1 || cells.size(0) == rays),
        "cells and places in them must be (R, D) like the ways, or (1, D)");
  check(steps.dim() == 1 && steps.size(0) == rays, "steps must be (R,), one a ray");
}

Tensor unmarked_cells(const Tensor& given_points, const Tensor& given_cells,
                      const Tensor& given_inside, const Tensor& given_ways,
                      const Tensor& given_steps) {
  const Tensor points = tidy(given_points), cells = tidy(given_cells), inside = tidy(given_inside);
  const Tensor ways = tidy(given_ways), steps = tidy(given_steps);
  check_rays(cells, inside, ways, steps);
  check(points.dim() == 2 && points.size(1) == ways.size(1) &&
            points.scalar_type() == ScalarType::Long,
        "points must be (N, D) numbers of cells, int64");
  const Tensor unmarked = new_empty(points, {points.size(0)}, ScalarType::Bool);
  const Rays rays{in<int64_t>(cells), in<int64_t>(steps), in<float>(inside),
                  in<float>(ways), ways.size(0), cells.size(0) == 1};
  Table table;
  const auto run = [&](auto dim) {
    for (int64_t row = 0; row < points.size(0); ++row)
      table.ask<dim()>(in<int64_t>(points) + row * dim());
    march_all<dim()>(rays, table);
    look_up<dim()>(in<int64_t>(points), points.size(0), table, out<bool>(unmarked));
  };
  if (ways.size(1) == 2)
    run(std::integral_constant<int, 2>{});
  else
    run(std::integral_constant<int, 3>{});
  return unmarked;
}

}  // namespace

std::vector<Operator> cells_operators() {
  return {
      {"unmarked_cells(Tensor points, Tensor cells, Tensor inside, Tensor ways, Tensor steps) -> "
       "Tensor",
       &boxed<unmarked_cells>},
  };
}

}  // namespace lardhm
