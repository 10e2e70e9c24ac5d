// Cells in which the log-odds exceed a target nowhere: an octree (in the plane, a quadtree) that is
// refined where rays ask.
//
// Let r be the distance from the middle of a cell to its corners, and d that of the middle's k-th center.
// A cluster is among the k nearest of some point of the cell only if its center is within d + 2r of the
// middle, and among those of all of its points if it is within d - 2r. So the log-odds are at most the
// sum over the former with positive weights, each at its largest, plus that over the latter with
// negative weights, each at its smallest. A whitened coordinate differs from that of the middle by no
// more than half an edge times the sum of the entries of its row of inv(L), by their size. Bounds of
// the fade follow from the same distances.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "kernel.h"
#include "search.h"
#include "sorting.h"

namespace lardhm {

constexpr double kRounding = 1e-5;    // fraction and log-odds added to a bound for float32
constexpr double kNegligible = 60;    // squared whitened distance beyond which a cluster adds 1e-13
constexpr double kCellMargin = 1e-3;  // of a cell, by which it is taken as larger

// Bounds of the log-odds in the cells around some points, given half of their edges.
template <class T, int D>
struct BoundVisitor final : Visitor<T, D> {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  using L = Layout<D>;
  static constexpr int W = Simd<T>::W;
  const T *positions, *shapes, *halves;
  T* bounds;

  BoundVisitor(const Parameters<T, D>& parameters, const T* halves_, T* bounds_)
      : positions(parameters.positions.data), shapes(parameters.shapes.data), halves(halves_),
        bounds(bounds_) {}

  void invalid(int64_t row) override { bounds[row] = std::numeric_limits<T>::infinity(); }

  void packet(const Packet<T, D>& packet, const Selection& selected) override {
    V half, nearby, sum = {};
    for (int lane = 0; lane < W; ++lane) {
      half[lane] = halves[packet.row(std::min(lane, packet.lanes - 1))];
      nearby[lane] = std::sqrt(packet.farthest[lane]);
    }
    const V corner = half * T(std::sqrt(double(D)));
    V inner = nearby - 2 * corner;  // clusters within it contribute everywhere
    inner = inner > 0 ? inner * inner * T(1 - kRounding) : V{};
    for (int64_t j = 0; j < selected.size; ++j) {
      const T* center = positions + int64_t(selected.rank[j]) * L::position;
      const T* shape = shapes + int64_t(selected.rank[j]) * L::shape;
      V offset[D], squared = {};
      for (int d = 0; d < D; ++d) {
        offset[d] = packet.x[d] - center[d];
        squared += offset[d] * offset[d];
      }
      const bool adds = shape[L::weight] > 0;
      const I counts = mask_of<T>(selected.bits[j]);
      const I shown = adds ? counts : counts & (squared < inner);
      if (!bits_of<T>(shown)) continue;
      const V z = whitened(offset, shape, adds ? -half : half);
      const I seen = shown & (z < T(kNegligible));
      if (!bits_of<T>(seen)) continue;
      const V fade = fade_within(packet, squared, nearby, adds ? corner : -corner);
      sum += seen ? exp_of<T>(T(-0.5) * z) * fade * shape[L::weight] : V{};
    }
    sum += (sum > 0 ? sum : -sum) * T(kRounding) + T(kRounding);
    store_rows<T, D>(sum, packet, bounds);
  }

 private:
  // Squared whitened distance, with every coordinate larger in size by `more` times its row's sum.
  static V whitened(const V* offset, const T* shape, V more) {
    V z[D], squared = {};
    whiten_offset<T, D>(offset, shape, z);
    T sums[D];
    const T* below = shape + L::below;
    sums[0] = shape[0];
    sums[1] = shape[1] * (1 + std::abs(shape[0] * below[0]));
    if constexpr (D == 3)
      sums[2] = shape[2] * (1 + std::abs(shape[1] * below[2]) +
                            std::abs(shape[0] * (below[0] * shape[1] * below[2] - below[1])));
    for (int d = 0; d < D; ++d) {
      V size = (z[d] > 0 ? z[d] : -z[d]) * T(1 - kRounding) + more * sums[d];
      size = size > 0 ? size : V{};
      squared += size * size;
    }
    return squared;
  }

  // The largest fade within `corner` of the middle or, for a negative one, the smallest: nowhere is a
  // center nearer, or the k-th farther, by more than that.
  static V fade_within(const Packet<T, D>& packet, V squared, V nearby, V corner) {
    V share = {};
    for (int lane = 0; lane < packet.lanes; ++lane) {
      if (packet.fading[lane] == 0) continue;
      const T distance = std::max(std::sqrt(squared[lane]) - corner[lane], T(0));
      const T farthest = std::max(nearby[lane] + corner[lane], std::numeric_limits<T>::min());
      share[lane] = distance / farthest * (corner[lane] > 0 ? T(1 - kRounding) : T(1 + kRounding));
    }
    return fade_of<T>(share * share);
  }
};

// The tree. Its cells are bounded group by group, when a ray enters one of them.
template <class T, int D>
class ClearCells {
 public:
  // A tree over a box, map frame [m], with leaves of some edge; cells of more than `largest` leaves an
  // edge are not bounded.
  ClearCells(const Box<double, D>& box, double leaf, int largest, double target_)
      : edge(leaf), target(target_) {
    double longest = 0;
    for (int d = 0; d < D; ++d) {
      base[d] = box.low[d];
      longest = std::max(longest, box.high[d] - box.low[d]);
    }
    while (longest > edge * std::ldexp(1.0, kMostLevels)) edge *= 2;
    while (longest > edge * std::ldexp(1.0, levels)) ++levels;
    while (1 << bounded < largest) ++bounded;
    nodes.assign(1, Node{-1, State::mixed});
  }

  // A point lies in a cell that is clear, or in one that may not be, or its bound is not known yet.
  enum class Place : int8_t { clear, mixed, waiting };

  // Looks up the cell of a point; where it is clear, `low` and `high` are its corners.
  Place find(const double* point, double* low, double* high) {
    int64_t at[D];
    for (int d = 0; d < D; ++d) {
      const double cell = (point[d] - base[d]) / edge;
      if (!(cell >= 0 && cell < std::ldexp(1.0, levels))) return Place::mixed;
      at[d] = int64_t(cell);
    }
    int32_t node = 0;
    for (int level = levels;; --level) {
      if (nodes[node].state == State::clear) {
        for (int d = 0; d < D; ++d) {
          low[d] = base[d] + edge * double(at[d] >> level << level);
          high[d] = low[d] + edge * double(int64_t(1) << level);
        }
        return Place::clear;
      }
      if (nodes[node].state == State::asked) return Place::waiting;
      if (level == 0) return Place::mixed;
      if (nodes[node].children < 0) open(node, level - 1, at);
      int child = 0;
      for (int d = 0; d < D; ++d) child |= int(at[d] >> (level - 1) & 1) << d;
      node = nodes[node].children + child;
    }
  }

  // Bounds all cells that were asked for.
  void answer(Search<T, D>& search, const Parameters<T, D>& parameters) {
    const int64_t n = int64_t(asked.size());
    if (n == 0) return;
    bounds.resize(n);
    BoundVisitor<T, D> visitor(parameters, halves.data(), bounds.data());
    search.visit(middles.data(), slack.data(), n, visitor, 1 << D);
    for (int64_t i = 0; i < n; ++i)
      nodes[asked[i]].state = bounds[i] <= target ? State::clear : State::mixed;
    asked.clear(), middles.clear(), halves.clear(), slack.clear();
  }

 private:
  static constexpr int kMostLevels = 24;
  enum class State : int8_t { asked, clear, mixed };
  struct Node {
    int32_t children;  // the first of them, after each other; -1: none
    State state;
  };

  double base[D], edge, target;  // edge of a leaf
  int levels = 0, bounded = 0;   // the root's, and the highest at which cells are bounded
  std::vector<Node> nodes;
  std::vector<int32_t> asked;
  std::vector<T> middles, halves, slack, bounds;

  // Makes the children of a node, cells of a level, the node being the one around a leaf.
  void open(int32_t node, int level, const int64_t* leaf) {
    const int32_t first = int32_t(nodes.size());
    nodes[node].children = first;
    nodes.resize(first + (1 << D), Node{-1, level <= bounded ? State::asked : State::mixed});
    if (level > bounded) return;
    const double child_edge = edge * double(int64_t(1) << level);
    const T half = T(0.5 * (1 + kCellMargin) * child_edge);
    for (int child = 0; child < 1 << D; ++child) {
      asked.push_back(first + child);
      for (int d = 0; d < D; ++d) {
        const int64_t corner = (leaf[d] >> (level + 1) << 1) + (child >> d & 1);
        middles.push_back(T(base[d] + child_edge * (double(corner) + 0.5)));
      }
      halves.push_back(half);
      slack.push_back(T(2 * std::sqrt(double(D))) * half);
    }
  }
};

}  // namespace lardhm
