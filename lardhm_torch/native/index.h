// Index of the centers: one block of bytes, a header and then the sections in the order of `Sections`.
//
// It holds the centers in the order of a Z curve ("rank") with the boxes of every 16: cheap to build,
// and independent of k.

#pragma once

#include <cstdint>
#include <cstring>
#include <limits>
#include <memory>

namespace lardhm {

constexpr uint64_t kMagic = 0x3278656d6864724cULL;
constexpr int kBlock = 16;        // centers in a block
constexpr float kFarAway = std::numeric_limits<float>::max();

struct Header {
  uint64_t magic, checksum;
  int64_t bytes, count;
  int32_t dim, item_size;
  double low[3], high[3];  // box of the centers [m]
};

inline uint64_t checksum(Header header) {
  header.checksum = 0;
  uint64_t words[sizeof(Header) / 8], hash = kMagic;
  static_assert(sizeof(Header) % 8 == 0, "the header is hashed in words");
  std::memcpy(words, &header, sizeof(header));
  for (uint64_t word : words) {
    hash = (hash ^ word) * 0xff51afd7ed558ccdULL;
    hash ^= hash >> 33;
  }
  return hash;
}

inline int64_t padded(int64_t count, int64_t to) { return (count + to - 1) / to * to; }

// Sections of a buffer after its header, one after the other, each aligned to 64 bytes.
struct Cursor {
  int64_t at;

  int64_t operator()(int64_t bytes) {
    const int64_t begin = padded(at, 64);
    at = begin + bytes;
    return begin;
  }
};

struct Sections {
  int64_t blocks, tiles, centers, order, relative, boxes, tile_boxes, end;

  explicit Sections(const Header& h) {
    Cursor section{sizeof(Header)};
    blocks = padded(h.count, kBlock) / kBlock;
    tiles = padded(blocks, kBlock) / kBlock;
    centers = section(h.count * h.dim * h.item_size);
    order = section(h.count * 4);
    relative = section(blocks * kBlock * h.dim * 4);
    boxes = section(tiles * kBlock * h.dim * 2 * 4);
    tile_boxes = section(padded(tiles, kBlock) * h.dim * 2 * 4);
    end = padded(section.at, 64);
  }
};

struct Index {
  Header header;
  int64_t blocks, tiles;
  const int32_t* order;   // (M,) rank -> row of the centers
  const float* relative;  // (blocks, D, kBlock) center - low, by rank; the padding is far away
  const float* boxes;     // (tiles, 2, D, kBlock) low and high corners of the blocks, 16 a tile
  const float* tile_boxes;  // (..., 2, D, kBlock) the same of the tiles, for maps of many clusters
};

inline Index view_of(const char* bytes) {
  Index index;
  std::memcpy(&index.header, bytes, sizeof(Header));
  const Sections at(index.header);
  index.blocks = at.blocks;
  index.tiles = at.tiles;
  index.order = reinterpret_cast<const int32_t*>(bytes + at.order);
  index.relative = reinterpret_cast<const float*>(bytes + at.relative);
  index.boxes = reinterpret_cast<const float*>(bytes + at.boxes);
  index.tile_boxes = reinterpret_cast<const float*>(bytes + at.tile_boxes);
  return index;
}

// Whether the bytes are an index of exactly these centers.
template <class T, int D>
bool matches(const char* bytes, int64_t size, const T* centers, int64_t count);

template <class T>
struct AlignedArray {
  std::unique_ptr<char[]> bytes;
  T* data = nullptr;

  void allocate(int64_t count) {
    bytes.reset(new char[count * sizeof(T) + 64]);
    data = reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(bytes.get()) + 63) / 64 * 64);
  }
};

// How many bytes the index of (count, D) centers has.
template <class T, int D>
int64_t index_size(int64_t count) {
  Header header{};
  header.count = count, header.dim = D, header.item_size = sizeof(T);
  return Sections(header).end;
}

// Writes the index of (count, D) centers.
template <class T, int D>
void write_index(const T* centers, int64_t count, char* to);

// An index for one call: the one given where it fits, else one of its own.
template <class T, int D>
struct CallIndex {
  AlignedArray<char> own;
  Index index;

  CallIndex(const char* given, int64_t size, const T* centers, int64_t count);
};

}  // namespace lardhm
