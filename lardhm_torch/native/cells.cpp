// Cells of space that rays pass through: a hash table with one bit per cell, as in
// `crossings.unmarked_cells`.

#include <algorithm>
#include <atomic>
#include <cmath>
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
constexpr uint32_t kPrimes[3] = {73856093, 19349669, 83492791};  // as crossings.PRIMES
constexpr int64_t kRaysPerTask = 256, kPointsPerTask = 8192;

// A power of two of bits; larger indices wrap around.
class Bits {
  std::vector<std::atomic<uint32_t>> words;
  uint32_t last;

 public:
  explicit Bits(int bits) : words(size_t(1) << (bits - 5)), last((uint32_t(1) << bits) - 1) {}

  // The 32 bits of which an entry has number `entry % 32`.
  uint32_t word(uint32_t entry) const {
    return words[(entry & last) >> 5].load(std::memory_order_relaxed);
  }

  bool has(uint32_t entry) const { return word(entry) >> (entry & 31) & 1; }

  void mark(uint32_t entry) {
    if (!has(entry))
      words[(entry & last) >> 5].fetch_or(1u << (entry & 31), std::memory_order_relaxed);
  }
};

// Rays mark only entries that belong to some point. These are few: most steps along a ray end after a
// look at a small table, which is not written while rays are followed.
struct Table {
  Bits glance{kGlanceBits}, asked{kTableBits}, crossed{kTableBits};

  void ask(uint32_t entry) {
    glance.mark(entry);
    asked.mark(entry);
  }

  void cross(uint32_t entry) {
    if (asked.has(entry)) crossed.mark(entry);
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

using Unsigned = uint32_t __attribute__((vector_size(kRegisterBytes)));

inline Unsigned whole_cells(Wide x) {
  const WideInt toward_zero = __builtin_convertvector(x, WideInt);
  return (Unsigned)(toward_zero + (__builtin_convertvector(toward_zero, Wide) > x));
}

// Marks the cells at half a cell, one and a half, ... along a ray from its start: a cell and the
// place inside it.
template <int D>
void march(const int64_t* cell, const float* inside, const float* way, int64_t steps,
           Table& table) {
  Wide lane;
  for (int j = 0; j < kWide; ++j) lane[j] = float(j) + 0.5f;
  for (int64_t step = 0; step < steps; step += kWide) {
    const Wide along = float(step) + lane;
    Unsigned entry = {};
    for (int d = 0; d < D; ++d) {
      const Wide at = inside[d] + rounded(along * way[d]);
      entry ^= (whole_cells(at) + uint32_t(cell[d])) * kPrimes[d];
    }
    entry &= kEntries;
    uint32_t entries[kWide], words[kWide];
    std::memcpy(entries, &entry, sizeof(entries));
    for (int j = 0; j < kWide; ++j) words[j] = table.glance.word(entries[j]);
    const Unsigned bit = load<Unsigned>(words) >> (entry & 31) & 1;
    const uint32_t some_set = ~bits_le<WideInt>((WideInt)bit, WideInt{});
    for (uint32_t some = some_set & existing(0, steps - step); some; some &= some - 1)
      table.cross(entries[__builtin_ctz(some)]);
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
      march<D>(rays.cells + start, rays.inside + start, rays.ways + ray * D, rays.steps[ray],
               table);
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
      table.ask(entry_of<dim()>(in<int64_t>(points) + row * dim()));
    march_all<dim()>(rays, table);
    look_up<dim()>(in<int64_t>(points), points.size(0), table, out<bool>(unmarked));
  };
  if (ways.size(1) == 2)
    run(std::integral_constant<int, 2>{});
  else
    run(std::integral_constant<int, 3>{});
  return unmarked;
}

constexpr int kMarkedBits = 20;  // as bridging.CELL_BITS

// Entry of the cell of a place in a table of 2^kMarkedBits.
template <class T, int D>
uint32_t marked_entry(const T* place, T edge) {
  uint32_t entry = 0;
  for (int d = 0; d < D; ++d) entry ^= uint32_t(int64_t(std::floor(place[d] / edge))) * kPrimes[d];
  return entry;  // of which only the low bits matter
}

// Whether the cell of a point, two radii wide, is one of those around some place.
Tensor in_cells_around(const Tensor& given_points, const Tensor& given_places, double radius) {
  const Tensor points = tidy(given_points), places = tidy(given_places);
  check_rows("points", points, places);
  const int64_t n = points.size(0);
  const Tensor found = new_empty(points, {n}, ScalarType::Bool);
  dispatch(points, [&](auto type, auto dim) {
    using T = decltype(type);
    constexpr int D = dim();
    const T edge = T(2 * radius);
    Bits marked(kMarkedBits);
    for (int64_t row = 0; row < places.size(0); ++row)
      for (int corner = 0; corner < 1 << D; ++corner) {
        T at[D];
        for (int d = 0; d < D; ++d)
          at[d] = in<T>(places)[row * D + d] + (corner >> d & 1 ? T(radius) : -T(radius));
        marked.mark(marked_entry<T, D>(at, edge));
      }
    run_tasks((n + kPointsPerTask - 1) / kPointsPerTask, [&](int64_t task) {
      const int64_t stop = std::min(n, (task + 1) * kPointsPerTask);
      for (int64_t row = task * kPointsPerTask; row < stop; ++row)
        out<bool>(found)[row] = marked.has(marked_entry<T, D>(in<T>(points) + row * D, edge));
    });
    return 0;
  });
  return found;
}

}  // namespace

std::vector<Operator> cells_operators() {
  return {
      {"in_cells_around(Tensor points, Tensor places, float radius) -> Tensor",
       &boxed<in_cells_around>},
      {"unmarked_cells(Tensor points, Tensor cells, Tensor inside, Tensor ways, Tensor steps) -> "
       "Tensor",
       &boxed<unmarked_cells>},
  };
}

}  // namespace lardhm
