// Inside the search: how one thread finds the exact k nearest centers of a run of points.
//
// Points are sorted along a Z curve over their box; each run of up to one register of neighboring
// points is a packet. Its candidates are the centers within a radius of the packet's box, found by
// filtering blocks of centers for a region of some thousand points, their members for a group of
// a hundred, and those for the packet. The radius is a guess from the packet before; if the k-th
// distance found turns out larger, the search is repeated with that distance, so the answer is
// exact anywhere in space. Pass 1 streams the candidates past the packet and keeps the k-th smallest
// distance; pass 2 shows the visitor the few centers within it.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "candidates.h"
#include "search.h"
#include "sorting.h"

namespace lardhm {

constexpr int64_t kMostPoints = 1024;  // in a region
constexpr double kNotZero = 1e-30;     // [m^2] farther than centers at the point itself
template <class T>  // so that rounding leaves the k-th center nothing
constexpr T kFully = 1 + 2 * std::numeric_limits<T>::epsilon();
constexpr double kRegionPoints = 3000, kGroupPoints = 160, kSparse = 25;

// How many sorted points share a list of blocks, a list of candidates, a register. The fewer points
// there are a center, the more centers lie between neighbors: where they are very sparse, a point
// by itself has the shortest list, unless at least some `together` are neighbors anyway.
struct Sharing {
  int64_t region, group, packet;

  Sharing(int64_t points, int64_t centers, int64_t lanes, int64_t together = 1) {
    const double sparsity = std::max(1.0, double(centers) / double(std::max<int64_t>(points, 1)));
    region = std::max<int64_t>(1, std::min(kMostPoints, int64_t(kRegionPoints / sparsity)));
    group = std::max<int64_t>(lanes, int64_t(kGroupPoints / sparsity));
    packet = lanes;
    if (sparsity > kSparse) group = packet = std::min(lanes, together);
    region = std::max(region, packet);
  }
};

// Points are uneven: cells are so fine that where most of them lie, a packet is larger than a cell.
constexpr double kCellsPerPoint = 8;

// Working memory of one thread.
template <class T, int D>
struct Scratch {
  Sorter sorter;
  std::vector<int32_t> order;  // of a region's points along the Z curve
  std::vector<T> x[D];         // their coordinates
  Blocks<D> far;
  Candidates<D> near;
  std::vector<int32_t> list;
  std::vector<uint32_t> bits;  // lanes that select each of the list
  Sharing sharing{0, 0, 1};
  Region<D> region, group;
  float far_radius = 0, near_radius = 0, radius = 0;  // [m] search radius of the lists and of a packet
  AlignedArray<typename Simd<T>::I> distance;
  int64_t room = 0;
  Selection selected;

  void make_room() {
    order.resize(kMostPoints);
    for (int d = 0; d < D; ++d) x[d].resize(kMostPoints + Simd<T>::W);
  }

  void reserve_list(int64_t n) {
    if (n <= room) return;
    room = 2 * n;
    list.resize(room + kBeyond);
    distance.allocate(room + kBeyond);
    bits.resize(room + kWide);
    selected.rank.resize(room + kWide);
    selected.bits.resize(room + kWide);
  }
};

template <class T, int D>
struct Engine {
  using V = typename Simd<T>::V;
  using I = typename Simd<T>::I;
  static constexpr int W = Simd<T>::W;

  Index index;
  const T* points;
  const T* slack = nullptr;  // [m] by point: centers this much farther than the k-th are shown, too
  int64_t together = 1;      // so many points lie side by side
  Parameters<T, D>& parameters;
  const T* positions;
  int k;
  KthFn<T, D> kth;
  bool fades;  // as `features.fades`
  T origin[D];
  float reach, smallest_radius;  // [m] edge of the centers' box; initial guess

  Engine(const T* points_, Parameters<T, D>& parameters_, int64_t k_)
      : index(parameters_.index), points(points_), parameters(parameters_),
        positions(parameters_.positions.data), k(int(k_)),
        kth(kth_distance_for<T, D>(int(k_))), fades(k_ > 1 && k_ < index.header.count), reach(0) {
    for (int d = 0; d < D; ++d) {
      origin[d] = T(index.header.low[d]);
      reach = std::max(reach, float(index.header.high[d] - index.header.low[d]));
    }
    smallest_radius = std::max(1e-18f, 1e-4f * reach);
  }

  // Sorts the finite points along a Z curve over their box, s.sorter.items; others are shown to
  // the visitor at once. Returns how many are left.
  int64_t sort_points(int64_t begin, int64_t end, Scratch<T, D>& s, Visitor<T, D>& visitor) const {
    Box<T, D> box;
    const bool all_finite = box.add(points, begin, end, 1);
    double edges[D];
    T low[D];
    for (int d = 0; d < D; ++d) {
      // Far outside the centers' box the order matters little, and would cost resolution inside.
      low[d] = std::max(box.low[d], T(index.header.low[d] - 0.5 * reach));
      const T high = std::min(box.high[d], T(index.header.high[d] + 0.5 * reach));
      edges[d] = std::max(double(high) - double(low[d]), 0.0);
    }
    const ZCurve<D> curve(edges, std::max<double>(1, double(end - begin) * kCellsPerPoint));
    curve.sort(points + begin * D, low, end - begin, s.sorter);
    if (all_finite) return end - begin;
    int64_t kept = 0;
    for (uint64_t item : s.sorter.items) {
      const int64_t row = begin + int64_t(uint32_t(item));
      if (is_finite(points + row * D, D))
        s.sorter.items[kept++] = item;
      else
        visitor.invalid(row);
    }
    return kept;
  }

  // Sorted points first .. stop axis by axis.
  void gather(int64_t begin, int64_t first, int64_t stop, Scratch<T, D>& s) const {
    constexpr int64_t kAhead = 24;
    const int64_t n = stop - first, last = int64_t(s.sorter.items.size()) - 1;
    const uint64_t* items = s.sorter.items.data();
    for (int64_t i = 0; i < n; ++i) {
      __builtin_prefetch(
          points + (begin + uint32_t(items[std::min(first + i + kAhead, last)])) * D);
      s.order[i] = int32_t(items[first + i]);
      const T* point = points + (begin + s.order[i]) * D;
      for (int d = 0; d < D; ++d) s.x[d][i] = point[d];
    }
  }

  // Where the run of sorted points i .. stop should end: not across a border of the Z curve's cells
  // whose cell holds many more points, for the curve jumps there and the run's box would be large.
  static int64_t cut(const std::vector<uint64_t>& items, int64_t n, int64_t i, int64_t stop) {
    const int64_t around = 8 * (stop - i);
    const auto key = [&items](int64_t at) { return uint32_t(items[at] >> 32); };
    while (key(i) != key(stop - 1)) {
      const int bit = 31 - __builtin_clz(key(i) ^ key(stop - 1));
      const uint32_t cell = key(i) >> (bit + 1);
      const bool crowded = (i >= around && key(i - around) >> (bit + 1) == cell) ||
                           (stop - 1 + around < n && key(stop - 1 + around) >> (bit + 1) == cell);
      if (!crowded) break;
      const uint64_t border = uint64_t(key(stop - 1) >> bit << bit) << 32;
      stop = std::lower_bound(items.begin() + i, items.begin() + stop, border) - items.begin();
    }
    return stop;
  }

  // One register of coordinates; lanes from `end` on hold the last point before it.
  static V coordinates(const std::vector<T>& x, int64_t i, int64_t end) {
    const V all = load<V>(x.data() + i);
    if (i + W <= end) return all;
    I lane;
    for (int j = 0; j < W; ++j) lane[j] = j;
    const typename Simd<T>::Int count = end - i;
    return lane < count ? all : x[end - 1] - V{};
  }

  static Box<T, D> box_of_sorted(const Scratch<T, D>& s, int64_t begin, int64_t end) {
    Box<T, D> box;
    for (int d = 0; d < D; ++d) {
      V low = coordinates(s.x[d], begin, end), high = low;
      for (int64_t i = begin + W; i < end; i += W) {
        const V x = coordinates(s.x[d], i, end);
        low = x < low ? x : low;
        high = x > high ? x : high;
      }
      box.low[d] = smallest_lane<T>(low);
      box.high[d] = -smallest_lane<T>(-high);
    }
    return box;
  }

  // Fills s.selected with the listed centers within the limit, k in each lane; ties go to the lower
  // row of the centers.
  void select(const Packet<T, D>& packet, I limit, int64_t n, Scratch<T, D>& s) const {
    const uint32_t all = ~0u >> (32 - packet.lanes);
    I count = {};
    for (int64_t i = 0; i < n; ++i) {
      const I distance = s.distance.data[i];
      s.bits[i] = bits_le<I>(distance, limit) & all;
      count -= distance <= limit;
    }
    const typename Simd<T>::Int most = k;
    if ((bits_le<I>(count, most - I{}) & all) != all) break_ties(packet.lanes, limit, n, s);
    keep_selected(n, s);
  }

  // Of the n listed centers, those that s.bits gives to some lane.
  static void keep_selected(int64_t n, Scratch<T, D>& s) {
    s.selected.size = 0;
    for (int64_t i = 0; i < n; i += kWide) {
      uint32_t some = ~bits_le<WideInt>(load<WideInt>(s.bits.data() + i), WideInt{});
      some &= existing(i, n);
      compress(some, s.list.data() + i, s.selected.rank.data() + s.selected.size);
      compress(some, s.bits.data() + i, s.selected.bits.data() + s.selected.size);
      s.selected.size += __builtin_popcount(some);
    }
  }

  // Of the candidates at exactly the k-th distance of a lane, keeps those of the lowest rows.
  void break_ties(int lanes, I limit, int64_t n, Scratch<T, D>& s) const {
    std::vector<std::pair<int32_t, int64_t>> tied;
    for (int lane = 0; lane < lanes; ++lane) {
      int nearer = 0;
      tied.clear();
      for (int64_t i = 0; i < n; ++i) {
        if (s.distance.data[i][lane] < limit[lane]) ++nearer;
        if (s.distance.data[i][lane] == limit[lane])
          tied.emplace_back(index.order[s.list[i]], i);
      }
      std::sort(tied.begin(), tied.end());
      for (size_t i = size_t(k - nearer); i < tied.size(); ++i)
        s.bits[tied[i].second] &= ~(1u << lane);
    }
  }

  // Shows the visitor the points begin .. end: packet by packet with s.selected filled in, or one
  // by one where a coordinate is not finite.
  void visit(int64_t begin, int64_t end, Scratch<T, D>& s, Visitor<T, D>& visitor) const {
    const int64_t n = sort_points(begin, end, s, visitor);
    s.make_room();
    s.sharing = Sharing(n, index.header.count, W, together);
    for (int64_t i = 0, stop; i < n; i = stop) {
      stop = cut(s.sorter.items, n, i, std::min(n, i + s.sharing.region));
      gather(begin, i, stop, s);
      visit_region(begin, n, i, stop, s, visitor);
    }
  }

  // The n points in s.x, neighbors after each other already, for a lattice of `total` points; a
  // point's row is `begin` and its s.order.
  void visit_filled(int64_t begin, int64_t n, int64_t total, Scratch<T, D>& s,
                    Visitor<T, D>& visitor) const {
    s.sharing = Sharing(total, index.header.count, W);
    s.sorter.items.assign(n, 0);  // one cell of the Z curve: no border
    visit_region(begin, n, 0, n, s, visitor);
  }

  // The sorted points first .. stop, whose coordinates are in s.x.
  void visit_region(int64_t begin, int64_t n, int64_t first, int64_t stop, Scratch<T, D>& s,
                    Visitor<T, D>& visitor) const {
    s.region = region_of(s, 0, stop - first);
    s.far_radius = -1;
    for (int64_t j = first, end; j < stop; j = end) {
      end = cut(s.sorter.items, n, j, std::min(stop, j + s.sharing.group));
      s.group = region_of(s, j - first, end - first);
      s.near_radius = -1;
      visit_group(begin, n, first, j, end, s, visitor);
    }
  }

  Region<D> region_of(const Scratch<T, D>& s, int64_t begin, int64_t end) const {
    return Region<D>(box_of_sorted(s, begin, end), origin, reach);
  }

  // The sorted points i .. stop of the region that begins at `first`.
  void visit_group(int64_t begin, int64_t n, int64_t first, int64_t i, int64_t stop,
                   Scratch<T, D>& s, Visitor<T, D>& visitor) const {
    Packet<T, D> packet;
    for (int64_t end; i < stop; i = end) {
      end = cut(s.sorter.items, n, i, std::min(stop, i + s.sharing.packet));
      packet.begin = begin;
      packet.order = s.order.data() + (i - first);
      packet.lanes = int(end - i);
      for (int d = 0; d < D; ++d) packet.x[d] = coordinates(s.x[d], i - first, end - first);
      search(packet, region_of(s, i - first, end - first), visitor.wants_bits(), s);
      visitor.packet(packet, s.selected);
    }
  }

  // Selects among the centers within a radius of the packet: a guess from the packet before. Where
  // the k-th distance turns out larger, that distance is the radius of the second attempt.
  void search(Packet<T, D>& packet, const Region<D>& region, bool bits, Scratch<T, D>& s) const {
    float radius = std::max(s.radius, smallest_radius);
    for (;;) {
      if (radius > s.near_radius) look_farther(1.3f * radius, s);
      const int64_t n = s.near.pick(region, radius, s.list.data());
      if (n < k) {
        radius = 2 * radius;
        continue;
      }
      std::fill_n(s.list.data() + n, kBeyond, int32_t(index.header.count));
      const I limit = kth(packet, positions, s.list.data(), n, k, s.distance.data);
      const float farthest = std::sqrt(float(-smallest_lane<T>(-(V)limit))) * 1.00001f;
      if (farthest <= radius) {
        s.radius = farthest * 1.15f;
        packet.farthest = (V)limit;
        packet.fading = fades ? kFully<T> / (packet.farthest + std::numeric_limits<T>::min()) : V{};
        packet.all_fade = fades && !bits && std::isfinite(farthest) &&
                          smallest_lane<T>(packet.farthest) > kNotZero;
        if (packet.all_fade) return select_nearer(packet, n, s);
        return slack ? select_farther(packet, region, s) : select(packet, limit, n, s);
      }
      radius = farthest;
    }
  }

  // Fills s.selected with those of the n listed centers that are nearer than a lane's k-th, and
  // packet.squared with their distances. The bits are left out.
  static void select_nearer(Packet<T, D>& packet, int64_t n, Scratch<T, D>& s) {
    const I limit = (I)packet.farthest;
    const uint32_t all = bits_le<I>(I{}, I{});
    int64_t size = 0;
    for (int64_t i = 0; i < n; ++i) {
      const I distance = s.distance.data[i];
      s.selected.rank[size] = s.list[i];
      s.distance.data[size] = distance;
      size += bits_le<I>(limit, distance) != all;
    }
    s.selected.size = size;
    packet.squared = (const V*)s.distance.data;
  }

  // Fills s.selected with the centers up to each lane's slack farther than its k-th.
  void select_farther(const Packet<T, D>& packet, const Region<D>& region, Scratch<T, D>& s) const {
    T limit[W], farthest[W];
    std::memcpy(farthest, &packet.farthest, sizeof(farthest));
    T most = 0;
    for (int lane = 0; lane < W; ++lane) {
      const int used = std::min(lane, packet.lanes - 1);
      limit[lane] = (std::sqrt(farthest[lane]) + slack[packet.row(used)]) * T(1.00001);
      most = std::max(most, limit[lane]);
      limit[lane] *= limit[lane];
    }
    if (float(most) > s.near_radius) look_farther(1.3f * float(most), s);
    const int64_t n = s.near.pick(region, float(most) * 1.00001f, s.list.data());
    for (int64_t i = 0; i < n; ++i) {
      const T* center = positions + int64_t(s.list[i]) * Layout<D>::position;
      s.distance.data[i] = (I)squared_distance<T, D>(packet, center);
    }
    const uint32_t all = ~0u >> (32 - packet.lanes);
    for (int64_t i = 0; i < n; ++i)
      s.bits[i] = bits_le<I>(s.distance.data[i], load<I>(limit)) & all;
    keep_selected(n, s);
  }

  // Fills s.near with the centers within the radius of the group, and s.far, of the region.
  void look_farther(float radius, Scratch<T, D>& s) const {
    if (radius > s.far_radius) {
      s.far_radius = 1.3f * radius;
      s.far.collect(index, s.region, s.far_radius);
    }
    s.near_radius = radius;
    s.near.collect(index, s.far, s.group, radius);
    if (!parameters.packed.empty()) parameters.need(s.near.rank, s.near.size);
    s.reserve_list(s.near.size);
  }
};

}  // namespace lardhm
