// A tree of boxes over flat faces or plates in Morton order: how it is laid out, and how it is made.
//
// A node holds one register of boxes, and so does a leaf of faces. Header and sections are one block
// of bytes.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "index.h"
#include "simd.h"
#include "sorting.h"

namespace lardhm {

constexpr int kFan = Simd<float>::W;  // children of a node, faces of a leaf
constexpr int kMostLevels = 32;
constexpr float kNowhere = 1e18f;  // where the padding lies; its square is finite
constexpr uint64_t kTreeMagic = 0x3173656361666472ULL;

template <int D>
struct FaceLayout {  // floats of a face: center, axes, half edges, rounding, half thickness
  static constexpr int center = 0, axes = D, half = D + D * D, radius = half + D - 1;
  static constexpr int thickness = radius + 1, count = 4 * D + (D == 3 ? 4 : 1);
};

struct TreeHeader {
  uint64_t magic;
  int64_t bytes, faces, levels;
  int64_t nodes[kMostLevels];  // of every level of boxes; level 0 has a box for each leaf
  double base[3];              // [m] what the tree's positions are relative to
  int32_t dim, fan;
};

struct TreeSections {
  int64_t order, leaves, boxes[kMostLevels], end;

  explicit TreeSections(const TreeHeader& h) {
    Cursor section{sizeof(TreeHeader)};
    const int64_t count = padded(h.faces, kFan);
    const int face = h.dim == 3 ? FaceLayout<3>::count : FaceLayout<2>::count;
    order = section(count * 4);
    leaves = section(count * face * 4);
    for (int64_t level = 0; level < h.levels; ++level)
      boxes[level] = section(h.nodes[level] * kFan * h.dim * 2 * 4);
    end = padded(section.at, 64);
  }
};

// F faces as the definition stores them, float64.
template <int D>
struct FaceArrays {
  const double *centers, *axes, *half, *thickness;  // no thickness (null): faces

  const double* axis(int64_t face) const { return axes + face * D * D; }
  const double* edges(int64_t face) const { return half + face * (D - 1); }
  double radius(int64_t face) const { return *std::min_element(edges(face), edges(face) + D - 1); }

  // How far the face reaches from its center along coordinate d [m].
  double extent(int64_t face, int d) const {
    const double r = radius(face);
    double sum = thickness ? std::abs(axis(face)[d * D]) * thickness[face] : 0, squares = 0;
    for (int j = 1; j < D; ++j) {
      const double u = axis(face)[d * D + j];
      sum += std::abs(u) * (edges(face)[j - 1] - r);
      squares += u * u;
    }
    return sum + r * std::sqrt(squares);
  }
};

template <int D>
TreeHeader header_of(const FaceArrays<D>& faces, int64_t count) {
  TreeHeader h{};
  h.magic = kTreeMagic;
  h.faces = count;
  h.dim = D;
  h.fan = kFan;
  Box<double, D> box;
  box.add(faces.centers, 0, count, 1);
  for (int d = 0; d < D; ++d) h.base[d] = count ? 0.5 * (box.low[d] + box.high[d]) : 0.0;
  for (int64_t nodes = (count + kFan - 1) / kFan; nodes > 0; ) {
    nodes = (nodes + kFan - 1) / kFan;
    h.nodes[h.levels++] = nodes;
    if (nodes == 1) break;
  }
  h.bytes = TreeSections(h).end;
  return h;
}

template <int D>
struct TreeBuilder {
  const FaceArrays<D>& faces;
  TreeHeader header;
  Sorter sorter;

  TreeBuilder(const FaceArrays<D>& faces_, int64_t count)
      : faces(faces_), header(header_of<D>(faces_, count)) {
    Box<double, D> box;
    box.add(faces.centers, 0, count, 1);
    double edges[D];
    for (int d = 0; d < D; ++d) edges[d] = std::max(box.high[d] - box.low[d], 0.0);
    ZCurve<D>(edges, double(4 * count + 1)).sort(faces.centers, box.low, count, sorter);
  }

  int32_t face_at(int64_t rank) const { return int32_t(uint32_t(sorter.items[rank])); }

  void write(char* to) const {
    const TreeSections at(header);
    std::memset(to, 0, at.end);
    std::memcpy(to, &header, sizeof(header));
    auto* order = reinterpret_cast<int32_t*>(to + at.order);
    auto* leaves = reinterpret_cast<float*>(to + at.leaves);
    const int64_t count = padded(header.faces, kFan);
    for (int64_t rank = 0; rank < count; ++rank) {
      const bool real = rank < header.faces;
      order[rank] = real ? face_at(rank) : -1;
      if (real) write_face(face_at(rank), leaves + rank * FaceLayout<D>::count);
    }
    for (int64_t level = 0; level < header.levels; ++level)
      write_boxes(level, to, at);
  }

 private:
  void write_face(int64_t face, float* to) const {
    using L = FaceLayout<D>;
    for (int d = 0; d < D; ++d)
      to[L::center + d] = float(faces.centers[face * D + d] - header.base[d]);
    for (int i = 0; i < D * D; ++i) to[L::axes + i] = float(faces.axis(face)[i]);
    for (int j = 0; j < D - 1; ++j) to[L::half + j] = float(faces.edges(face)[j]);
    to[L::radius] = float(faces.radius(face));
    to[L::thickness] = faces.thickness ? float(faces.thickness[face]) : 0;
  }

  // Boxes of the leaves (level 0) or of the nodes one level below.
  void write_boxes(int64_t level, char* to, const TreeSections& at) const {
    auto* boxes = reinterpret_cast<float*>(to + at.boxes[level]);
    const auto* below = level ? reinterpret_cast<const float*>(to + at.boxes[level - 1]) : nullptr;
    const int64_t children =
        level ? header.nodes[level - 1] : (header.faces + kFan - 1) / kFan;
    for (int64_t i = 0; i < header.nodes[level] * kFan; ++i)
      for (int d = 0; d < D; ++d) {
        float low = kNowhere, high = kNowhere;
        if (i < children) level ? join(below, i, d, low, high) : cover(i, d, low, high);
        float* node = boxes + i / kFan * kFan * D * 2 + i % kFan;
        node[d * kFan] = low;
        node[(D + d) * kFan] = high;
      }
  }

  void cover(int64_t leaf, int d, float& low, float& high) const {
    double from = std::numeric_limits<double>::infinity(), to = -from;
    const int64_t stop = std::min(header.faces, (leaf + 1) * kFan);
    for (int64_t rank = leaf * kFan; rank < stop; ++rank) {
      const int64_t face = face_at(rank);
      const double middle = faces.centers[face * D + d] - header.base[d];
      const double extent = faces.extent(face, d) * (1 + 1e-6);
      from = std::min(from, middle - extent);
      to = std::max(to, middle + extent);
    }
    low = float(from), high = float(to);
  }

  static void join(const float* below, int64_t node, int d, float& low, float& high) {
    const float* boxes = below + node * kFan * D * 2;
    low = boxes[d * kFan], high = boxes[(D + d) * kFan];
    for (int lane = 1; lane < kFan; ++lane) {
      if (boxes[d * kFan + lane] == kNowhere) continue;  // padding follows what is real
      low = std::min(low, boxes[d * kFan + lane]);
      high = std::max(high, boxes[(D + d) * kFan + lane]);
    }
  }
};

template <int D>
struct Tree {
  using V = Simd<float>::V;
  using I = Simd<float>::I;
  TreeHeader header;
  const int32_t* order;
  const float *leaves, *boxes[kMostLevels];

  explicit Tree(const char* bytes) {
    std::memcpy(&header, bytes, sizeof(header));
    const TreeSections at(header);
    order = reinterpret_cast<const int32_t*>(bytes + at.order);
    leaves = reinterpret_cast<const float*>(bytes + at.leaves);
    for (int64_t level = 0; level < header.levels; ++level)
      boxes[level] = reinterpret_cast<const float*>(bytes + at.boxes[level]);
  }
};

}  // namespace lardhm
