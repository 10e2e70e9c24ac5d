// Search: the exact k nearest centers of every point, packet by packet, shown to visitors.

#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "packets.h"

namespace lardhm {

// Called with a packet and the clusters it selected, or with a point that is not finite.
template <class T, int D>
struct Visitor {
  virtual ~Visitor() = default;
  virtual bool wants_bits() const { return true; }  // also of a packet whose neighbors all fade
  virtual void invalid(int64_t row) = 0;
  virtual void packet(const Packet<T, D>& packet, const Selection& selected) = 0;
};

// Shows every point with its k nearest centers once, to the one visitor of all threads.
template <class T, int D>
void visit_all(const T* points, int64_t n, Parameters<T, D>& parameters, int64_t k,
               Visitor<T, D>& visitor);

// The same in as many parts of the points as there are visitors, one per part: their sums depend on
// the number of parts, not on the timing of the threads.
template <class T, int D>
void visit_parts(const T* points, int64_t n, Parameters<T, D>& parameters, int64_t k,
                 const std::vector<Visitor<T, D>*>& visitors);

template <class T, int D, class Own>
std::vector<Visitor<T, D>*> each_of(std::vector<Own>& own) {
  std::vector<Visitor<T, D>*> visitors;
  for (Own& visitor : own) visitors.push_back(&visitor);
  return visitors;
}

// Shows all points of a lattice, the D lists of coordinates in `axes` (shape[d] finite ones each, the
// last axis fastest), brick by brick: there is nothing to sort, and no point is ever stored.
template <class T, int D>
void visit_lattice(const T* const* axes, const int64_t* shape, Parameters<T, D>& parameters,
                   int64_t k, Visitor<T, D>& visitor);

// Shows the points of cubes of a lattice with `edge` points along each axis, the first ones at
// `firsts` (blocks, D); row edge^D b + ... + e is point (..., e) of cube b.
template <class T, int D>
void visit_cubes(const T* const* axes, const int64_t* firsts, int64_t cubes, int64_t edge,
                 Parameters<T, D>& parameters, int64_t k, Visitor<T, D>& visitor);

template <class T, int D>
struct Scratch;

// The search on one thread, with memory that is reused between calls.
template <class T, int D>
class Search {
 public:
  Search(Parameters<T, D>& parameters, int64_t k);
  ~Search();

  // Shows the visitor n points with their k nearest centers and, where slack [m] by point is given,
  // all that are no more than that much farther than the k-th. At least `together` of them each are
  // neighbors.
  void visit(const T* points, const T* slack, int64_t n, Visitor<T, D>& visitor,
             int64_t together = 1);

 private:
  Parameters<T, D>& parameters;
  int64_t k;
  std::unique_ptr<Scratch<T, D>> scratch;
};

// Number of partial sums: one per thread, fewer if merging them would dominate.
template <class T, int D>
int64_t parts_of(int64_t n, int64_t bytes_of_sums, const Parameters<T, D>& parameters) {
  if (!parameters.packed.empty()) return 1;
  const int64_t by_work = (n + 1023) / 1024;
  const int64_t by_memory = (int64_t(1) << 29) / std::max<int64_t>(bytes_of_sums, 1);
  return std::max<int64_t>(1, std::min({num_threads(), by_work, by_memory}));
}

}  // namespace lardhm
