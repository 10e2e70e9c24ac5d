// Running visitors over all points, on all threads.

#include <algorithm>
#include <atomic>
#include <cstdint>

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

}  // namespace

template <class T, int D>
void visit_all(const T* points, int64_t n, Parameters<T, D>& parameters, int64_t k,
               const MakeVisitor<T, D>& make) {
  if (n == 0) return;
  const Engine<T, D> engine(points, parameters, k);
  const int64_t threads = parameters.packed.empty() ? num_threads() : 1;
  const int64_t block = block_size(engine, n, threads);
  const int64_t blocks = (n + block - 1) / block;
  std::atomic<int64_t> next{0};
  run_tasks(std::min(blocks, threads), [&](int64_t worker) {
    Scratch<T, D> scratch;
    const auto visitor = make(worker);
    for (int64_t i = next++; i < blocks; i = next++)
      engine.visit(i * block, std::min(n, (i + 1) * block), scratch, *visitor);
  });
}

template <class T, int D>
void visit_parts(const T* points, int64_t n, Parameters<T, D>& parameters, int64_t k, int64_t parts,
                 const MakeVisitor<T, D>& make) {
  const Engine<T, D> engine(points, parameters, k);
  const int64_t block = block_size(engine, n, parts);
  run_tasks(parts, [&](int64_t part) {
    Scratch<T, D> scratch;
    const auto visitor = make(part);
    const int64_t begin = n * part / parts, end = n * (part + 1) / parts;
    for (int64_t i = begin; i < end; i += block)
      engine.visit(i, std::min(end, i + block), scratch, *visitor);
  });
}

#define LARDHM_INSTANTIATE(T, D)                                                                 \
  template void visit_all<T, D>(const T*, int64_t, Parameters<T, D>&, int64_t,                   \
                                const MakeVisitor<T, D>&);                                       \
  template void visit_parts<T, D>(const T*, int64_t, Parameters<T, D>&, int64_t, int64_t,        \
                                  const MakeVisitor<T, D>&);
LARDHM_INSTANTIATE(float, 2)
LARDHM_INSTANTIATE(float, 3)
LARDHM_INSTANTIATE(double, 2)
LARDHM_INSTANTIATE(double, 3)
#undef LARDHM_INSTANTIATE

}  // namespace lardhm
