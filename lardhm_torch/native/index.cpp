// Making and checking the index.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "index.h"
#include "sorting.h"

namespace lardhm {

// Whether the bytes are an index of exactly these centers.
template <class T, int D>
bool matches(const char* bytes, int64_t size, const T* centers, int64_t count) {
  Header h;
  if (size < int64_t(sizeof(Header)) || reinterpret_cast<uintptr_t>(bytes) % 8 != 0) return false;
  std::memcpy(&h, bytes, sizeof(Header));
  if (h.magic != kMagic || h.bytes != size || h.checksum != checksum(h)) return false;
  if (h.count != count || h.dim != D || h.item_size != int(sizeof(T))) return false;
  const Sections at(h);
  if (at.end != size) return false;
  const auto* order = reinterpret_cast<const uint32_t*>(bytes + at.order);
  uint32_t largest = 0;
  for (int64_t i = 0; i < count; ++i) largest = std::max(largest, order[i]);
  return (count == 0 || largest < count) &&
         std::memcmp(bytes + at.centers, centers, sizeof(T) * D * count) == 0;
}

namespace {

template <class T, int D>
struct IndexBuilder {
  Header header{};
  const T* centers;
  std::vector<int32_t> order;

  IndexBuilder(const T* centers_, int64_t count) : centers(centers_) {
    Box<T, D> box;
    box.add(centers, 0, count, 1);
    header.magic = kMagic;
    header.count = count;
    header.dim = D;
    header.item_size = sizeof(T);
    for (int d = 0; d < D; ++d) {
      const bool any = box.low[d] <= box.high[d];  // finite coordinates
      header.low[d] = any ? double(box.low[d]) : 0.0;
      header.high[d] = any ? double(box.high[d]) : 0.0;
    }
    header.bytes = Sections(header).end;
    header.checksum = checksum(header);
    sort_centers();
  }

  float relative(int64_t row, int d) const {
    return float(centers[row * D + d] - T(header.low[d]));
  }

  void sort_centers() {
    double edges[D];
    for (int d = 0; d < D; ++d) edges[d] = header.high[d] - header.low[d];
    T low[D];
    for (int d = 0; d < D; ++d) low[d] = T(header.low[d]);
    Sorter sorter;
    ZCurve<D>(edges, double(4 * header.count + 1)).sort(centers, low, header.count, sorter);
    order.resize(header.count);
    for (int64_t rank = 0; rank < header.count; ++rank) order[rank] = int32_t(sorter.items[rank]);
  }

  void write(char* to) const {
    const Sections at(header);
    std::memset(to, 0, at.end);  // gaps, too: equal centers give equal bytes
    std::memcpy(to, &header, sizeof(Header));
    std::copy_n(centers, D * header.count, reinterpret_cast<T*>(to + at.centers));  // none may be null
    std::copy_n(order.data(), order.size(), reinterpret_cast<int32_t*>(to + at.order));
    auto* relative_to = reinterpret_cast<float*>(to + at.relative);
    auto* boxes = reinterpret_cast<float*>(to + at.boxes);
    auto* tile_boxes = reinterpret_cast<float*>(to + at.tile_boxes);
    std::fill(relative_to, relative_to + at.blocks * kBlock * D, kFarAway);
    std::fill(boxes, boxes + at.tiles * kBlock * D * 2, kFarAway);
    for (int64_t block = 0; block < at.blocks; ++block) {
      float* box = boxes + block / kBlock * kBlock * D * 2 + block % kBlock;
      for (int d = 0; d < D; ++d)
        write_axis(block, d, relative_to + (block * D + d) * kBlock, box + d * kBlock,
                   box + (D + d) * kBlock);
    }
    for (int64_t tile = 0; tile < at.tiles; ++tile) {
      const int members = int(std::min<int64_t>(kBlock, at.blocks - tile * kBlock));
      const float* from = boxes + tile * kBlock * D * 2;
      float* box = tile_boxes + tile / kBlock * kBlock * D * 2 + tile % kBlock;
      for (int i = 0; i < 2 * D; ++i, from += kBlock)
        box[i * kBlock] = i < D ? *std::min_element(from, from + members)
                                : *std::max_element(from, from + members);
    }
  }

  void write_axis(int64_t block, int d, float* to, float* low, float* high) const {
    const int64_t first = block * kBlock;
    const int members = int(std::min<int64_t>(kBlock, header.count - first));
    for (int i = 0; i < members; ++i) {
      const float x = relative(order[first + i], d);
      if (std::isfinite(x)) to[i] = x;
    }
    *low = *std::min_element(to, to + members);
    *high = *std::max_element(to, to + members);
  }
};

}  // namespace

template <class T, int D>
void write_index(const T* centers, int64_t count, char* to) {
  IndexBuilder<T, D>(centers, count).write(to);
}

template <class T, int D>
CallIndex<T, D>::CallIndex(const char* given, int64_t size, const T* centers, int64_t count) {
  if (matches<T, D>(given, size, centers, count)) {
    index = view_of(given);
    return;
  }
  own.allocate(index_size<T, D>(count));
  write_index<T, D>(centers, count, own.data);
  index = view_of(own.data);
}

#define LARDHM_INSTANTIATE(T, D)                                        \
  template bool matches<T, D>(const char*, int64_t, const T*, int64_t); \
  template void write_index<T, D>(const T*, int64_t, char*);            \
  template struct CallIndex<T, D>;
LARDHM_INSTANTIATE(float, 2)
LARDHM_INSTANTIATE(float, 3)
LARDHM_INSTANTIATE(double, 2)
LARDHM_INSTANTIATE(double, 3)
#undef LARDHM_INSTANTIATE

}  // namespace lardhm
