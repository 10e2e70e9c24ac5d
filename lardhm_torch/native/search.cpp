// Running visitors over all points, on all threads.

#include <algorithm>
#include <array>
#include <atomic>
#include <cstdint>
#include <vector>

#include "engine.h"

namespace lardhm {
namespace {

constexpr int64_t kSmallBlock = 32768;
constexpr int64_t kLargeBlock = int64_t(1) << 20;

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

// The thread's working memory, kept between calls unless it is large: to ask for it anew takes up to
// a tenth of a query.
template <class T, int D>
struct OwnScratch {
  static constexpr size_t kKept = size_t(1) << 18;  // points
  Scratch<T, D>& scratch;

  OwnScratch() : scratch(of_thread()) { scratch.radius = 0; }

  ~OwnScratch() {
    if (scratch.sorter.items.capacity() > kKept) scratch.sorter = Sorter();
  }

  static Scratch<T, D>& of_thread() {
    static thread_local Scratch<T, D> scratch;
    return scratch;
  }
};

}  // namespace

template <class T, int D>
void visit_all(const T* points, int64_t n, Parameters<T, D>& parameters, int64_t k,
               Visitor<T, D>& visitor) {
  if (n == 0) return;
  const Engine<T, D> engine(points, parameters, k);
  const int64_t threads = parameters.packed.empty() ? num_threads() : 1;
  const int64_t block = block_size(engine, n, threads);
  const int64_t blocks = (n + block - 1) / block;
  std::atomic<int64_t> next{0};
  run_tasks(std::min(blocks, threads), [&](int64_t) {
    const OwnScratch<T, D> own;
    for (int64_t i = next++; i < blocks; i = next++)
      engine.visit(i * block, std::min(n, (i + 1) * block), own.scratch, visitor);
  });
}

template <class T, int D>
void visit_parts(const T* points, int64_t n, Parameters<T, D>& parameters, int64_t k,
                 const std::vector<Visitor<T, D>*>& visitors) {
  const int64_t parts = int64_t(visitors.size());
  const Engine<T, D> engine(points, parameters, k);
  const int64_t block = block_size(engine, n, parts);
  run_tasks(parts, [&](int64_t part) {
    const OwnScratch<T, D> own;
    const int64_t begin = n * part / parts, end = n * (part + 1) / parts;
    for (int64_t i = begin; i < end; i += block)
      engine.visit(i, std::min(end, i + block), own.scratch, *visitors[part]);
  });
}

namespace {

// Bricks of a lattice: cubes of kBrick points an edge, in cubes of 4, in runs of packets.
template <int D>
constexpr int kBrick = D == 3 ? 8 : 32;

template <int D>
struct Lattice {
  int64_t shape[D], bricks[D], total = 1, tasks = 1;

  explicit Lattice(const int64_t* shape_) {
    for (int d = 0; d < D; ++d) {
      shape[d] = shape_[d];
      bricks[d] = (shape[d] + kBrick<D> - 1) / kBrick<D>;
      total *= shape[d];
      tasks *= bricks[d];
    }
  }

  // First point of a brick, and how many it has along each axis.
  void corner(int64_t brick, int64_t* first, int* edge) const {
    for (int d = D - 1; d >= 0; --d) {
      first[d] = brick % bricks[d] * kBrick<D>;
      edge[d] = int(std::min<int64_t>(kBrick<D>, shape[d] - first[d]));
      brick /= bricks[d];
    }
  }

  int64_t row(const int64_t* at) const {
    int64_t row = 0;
    for (int d = 0; d < D; ++d) row = row * shape[d] + at[d];
    return row;
  }
};

// Steps from the corner of a cube along each axis, along a Z curve; an edge has a power of 2 points.
template <int D>
std::vector<std::array<int8_t, D>> brick_order(int edge) {
  std::vector<std::array<int8_t, D>> order;
  int count = 1;
  for (int d = 0; d < D; ++d) count *= edge;
  for (int code = 0; code < count; ++code) {
    std::array<int8_t, D> step{};
    for (int bit = 0; (1 << bit) < count; ++bit)
      step[D - 1 - bit % D] |= int8_t((code >> bit & 1) << bit / D);
    order.push_back(step);
  }
  return order;
}

// Puts a brick's points into the scratch; returns how many there are.
template <class T, int D>
int64_t fill_brick(const T* const* axes, const Lattice<D>& lattice, const int64_t* first,
                   const int* edge, const std::vector<std::array<int8_t, D>>& order,
                   Scratch<T, D>& s) {
  int64_t n = 0;
  for (const auto& step : order) {
    int64_t offset = 0;
    bool inside = true;
    for (int d = 0; d < D; ++d) {
      inside &= step[d] < edge[d];
      offset = offset * lattice.shape[d] + step[d];
    }
    if (!inside) continue;
    for (int d = 0; d < D; ++d) s.x[d][n] = axes[d][first[d] + step[d]];
    s.order[n++] = int32_t(offset);
  }
  return n;
}

}  // namespace

template <class T, int D>
void visit_lattice(const T* const* axes, const int64_t* shape, Parameters<T, D>& parameters,
                   int64_t k, Visitor<T, D>& visitor) {
  const Lattice<D> lattice(shape);
  const Engine<T, D> engine(nullptr, parameters, k);
  const auto order = brick_order<D>(kBrick<D>);
  const int64_t threads = parameters.packed.empty() ? num_threads() : 1;
  std::atomic<int64_t> next{0};
  run_tasks(std::min(lattice.tasks, threads), [&](int64_t) {
    constexpr int64_t kRun = 16;  // bricks taken at a time
    Scratch<T, D> scratch;
    scratch.make_room();
    for (int64_t begin = kRun * next++; begin < lattice.tasks; begin = kRun * next++)
      for (int64_t brick = begin; brick < std::min(lattice.tasks, begin + kRun); ++brick) {
        int64_t first[D];
        int edge[D];
        lattice.corner(brick, first, edge);
        const int64_t n = fill_brick<T, D>(axes, lattice, first, edge, order, scratch);
        engine.visit_filled(lattice.row(first), n, lattice.total, scratch, visitor);
      }
  });
}

template <class T, int D>
void visit_cubes(const T* const* axes, const int64_t* firsts, int64_t cubes, int64_t edge,
                 Parameters<T, D>& parameters, int64_t k, Visitor<T, D>& visitor) {
  const Engine<T, D> engine(nullptr, parameters, k);
  int wide = 1;
  while (wide < edge) wide *= 2;
  auto order = brick_order<D>(wide);
  const auto outside = [edge](const auto& step) {
    return *std::max_element(step.begin(), step.end()) >= edge;
  };
  order.erase(std::remove_if(order.begin(), order.end(), outside), order.end());
  const int64_t points = int64_t(order.size());
  const int64_t threads = parameters.packed.empty() ? num_threads() : 1;
  std::atomic<int64_t> next{0};
  run_tasks(std::min(cubes, threads), [&](int64_t) {
    Scratch<T, D> scratch;
    scratch.make_room();
    for (int64_t cube = next++; cube < cubes; cube = next++) {
      const int64_t* first = firsts + cube * D;
      for (int64_t i = 0; i < points; ++i) {
        int64_t row = 0;
        for (int d = 0; d < D; ++d) {
          scratch.x[d][i] = axes[d][first[d] + order[i][d]];
          row = row * edge + order[i][d];
        }
        scratch.order[i] = int32_t(row);
      }
      engine.visit_filled(cube * points, points, cubes * points, scratch, visitor);
    }
  });
}

template <class T, int D>
Search<T, D>::Search(Parameters<T, D>& parameters_, int64_t k_)
    : parameters(parameters_), k(k_), scratch(new Scratch<T, D>) {}

template <class T, int D>
Search<T, D>::~Search() = default;

template <class T, int D>
void Search<T, D>::visit(const T* points, const T* slack, int64_t n, Visitor<T, D>& visitor,
                         int64_t together) {
  Engine<T, D> engine(points, parameters, k);
  engine.slack = slack;
  engine.together = together;
  if (n) engine.visit(0, n, *scratch, visitor);
}

#define LARDHM_INSTANTIATE(T, D)                                                                   \
  template void visit_all<T, D>(const T*, int64_t, Parameters<T, D>&, int64_t, Visitor<T, D>&);    \
  template void visit_parts<T, D>(const T*, int64_t, Parameters<T, D>&, int64_t,                   \
                                  const std::vector<Visitor<T, D>*>&);                             \
  template void visit_lattice<T, D>(const T* const*, const int64_t*, Parameters<T, D>&, int64_t,   \
                                    Visitor<T, D>&);                                               \
  template void visit_cubes<T, D>(const T* const*, const int64_t*, int64_t, int64_t,               \
                                  Parameters<T, D>&, int64_t, Visitor<T, D>&);                     \
  template class Search<T, D>;
LARDHM_INSTANTIATE(float, 2)
LARDHM_INSTANTIATE(float, 3)
LARDHM_INSTANTIATE(double, 2)
LARDHM_INSTANTIATE(double, 3)
#undef LARDHM_INSTANTIATE

}  // namespace lardhm
