// Marching cubes on a batch of small blocks, as `marching.plain_march` defines it.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "tensors.h"

namespace lardhm {
namespace {

constexpr int64_t kBlocksAtOnce = 32;

struct Cases {
  const int8_t* triangles;  // (256, most, 3)
  int64_t most;
};

// What some consecutive blocks contribute.
struct Part {
  std::vector<int64_t> edges;
  std::vector<float> shares;
  std::vector<int32_t> faces;
};

struct Marcher {
  const float* values;
  const int64_t* cells;
  float level;
  int64_t n;
  Cases cases;
  int64_t strides[3];
  std::vector<int32_t> ids;      // vertex of each edge of the block; only crossed ones are set
  std::vector<uint8_t> inside;

  Marcher(const float* values_, const int64_t* cells_, float level_, int64_t n_, Cases cases_)
      : values(values_), cells(cells_), level(level_), n(n_), cases(cases_),
        strides{n_ * n_, n_, 1}, ids(3 * n_ * n_ * n_), inside(n_ * n_ * n_) {}

  void march(int64_t block, Part& part) {
    const int64_t points = n * n * n, *count = cells + 3 * block;
    if (std::min({count[0], count[1], count[2]}) < 1) return;
    const float* value = values + block * points;
    bool some = false, all = true;
    for (int64_t i = 0; i < points; ++i) {
      inside[i] = value[i] > level;
      some |= inside[i], all &= inside[i];
    }
    if (!some || all) return;
    cut_edges(block, value, count, part);
    for (int64_t i = 0; i < count[0]; ++i)
      for (int64_t j = 0; j < count[1]; ++j)
        for (int64_t k = 0; k < count[2]; ++k) cut_cell(i * strides[0] + j * strides[1] + k, part);
  }

 private:
  void cut_edges(int64_t block, const float* value, const int64_t* count, Part& part) {
    for (int64_t i = 0; i <= count[0]; ++i)
      for (int64_t j = 0; j <= count[1]; ++j)
        for (int64_t k = 0; k <= count[2]; ++k) {
          const int64_t at[3] = {i, j, k}, point = i * strides[0] + j * strides[1] + k;
          for (int axis = 0; axis < 3; ++axis) {
            if (at[axis] == count[axis]) continue;
            const int64_t next = point + strides[axis];
            if (inside[point] == inside[next]) continue;
            ids[3 * point + axis] = int32_t(part.edges.size());
            part.edges.push_back(3 * (block * n * n * n + point) + axis);
            part.shares.push_back((level - value[point]) / (value[next] - value[point]));
          }
        }
  }

  void cut_cell(int64_t point, Part& part) {
    unsigned code = 0;
    for (int corner = 0; corner < 8; ++corner)
      code |= unsigned(inside[point + shift(corner)]) << corner;
    if (code == 0 || code == 255) return;
    const int8_t* triangle = cases.triangles + int64_t(code) * cases.most * 3;
    for (int64_t t = 0; t < cases.most && triangle[3 * t] >= 0; ++t)
      for (int v = 0; v < 3; ++v) {
        const int axis = triangle[3 * t + v] / 4;
        const int64_t base = point + shift(base_corner(axis, triangle[3 * t + v] % 4));
        part.faces.push_back(ids[3 * base + axis]);
      }
  }

  int64_t shift(int corner) const {
    return (corner >> 2) * strides[0] + (corner >> 1 & 1) * strides[1] + (corner & 1);
  }

  // The nth corner, ascending, whose bit of this axis is 0.
  static int base_corner(int axis, int nth) {
    const int bit = 2 - axis, low = nth & ((1 << bit) - 1);
    return (nth >> bit << (bit + 1)) | low;
  }
};

Tensors<3> march_blocks(const Tensor& given_values, double level, const Tensor& given_cells,
                        const Tensor& given_table) {
  const Tensor values = tidy(given_values), cells = tidy(given_cells), table = tidy(given_table);
  check(values.dim() == 4 && values.scalar_type() == ScalarType::Float && values.size(1) > 1 &&
            values.size(1) == values.size(2) && values.size(2) == values.size(3),
        "values must be (B, n, n, n) float32, n > 1");
  const int64_t blocks = values.size(0), n = values.size(1);
  check(cells.dim() == 2 && cells.size(0) == blocks && cells.size(1) == 3 &&
            cells.scalar_type() == ScalarType::Long,
        "cells must be (B, 3) int64");
  for (int64_t i = 0; i < 3 * blocks; ++i)
    check(in<int64_t>(cells)[i] < n, "cells must be less than n");
  check(table.dim() == 3 && table.size(0) == 256 && table.size(2) == 3 &&
            table.scalar_type() == ScalarType::Char,
        "table must be (256, T, 3) int8");
  for (int64_t i = 0; i < table.numel(); ++i)
    check(in<int8_t>(table)[i] < 12, "table must hold edges from 0 to 11");
  const Cases cases{in<int8_t>(table), table.size(1)};
  const int64_t tasks = (blocks + kBlocksAtOnce - 1) / kBlocksAtOnce;
  std::vector<Part> parts(tasks);
  run_tasks(tasks, [&](int64_t task) {
    Marcher marcher(in<float>(values), in<int64_t>(cells), float(level), n, cases);
    const int64_t end = std::min(blocks, (task + 1) * kBlocksAtOnce);
    for (int64_t block = task * kBlocksAtOnce; block < end; ++block) marcher.march(block, parts[task]);
  });
  std::vector<int64_t> first(tasks + 1, 0), first_face(tasks + 1, 0);
  for (int64_t task = 0; task < tasks; ++task) {
    first[task + 1] = first[task] + int64_t(parts[task].edges.size());
    first_face[task + 1] = first_face[task] + int64_t(parts[task].faces.size()) / 3;
  }
  check(first[tasks] < (int64_t(1) << 31), "the blocks of one call must have fewer than 2^31 vertices");
  const Tensor edges = new_empty(values, {first[tasks]}, ScalarType::Long);
  const Tensor shares = new_empty(values, {first[tasks]});
  const Tensor faces = new_empty(values, {first_face[tasks], 3}, ScalarType::Int);
  run_tasks(tasks, [&](int64_t task) {
    const Part& part = parts[task];
    std::copy(part.edges.begin(), part.edges.end(), out<int64_t>(edges) + first[task]);
    std::copy(part.shares.begin(), part.shares.end(), out<float>(shares) + first[task]);
    int32_t* to = out<int32_t>(faces) + 3 * first_face[task];
    for (size_t i = 0; i < part.faces.size(); ++i) to[i] = part.faces[i] + int32_t(first[task]);
  });
  return {edges, shares, faces};
}

}  // namespace

std::vector<Operator> marching_operators() {
  return {
      {"march_blocks(Tensor values, float level, Tensor cells, Tensor table) "
       "-> (Tensor, Tensor, Tensor)",
       &boxed<march_blocks>},
  };
}

}  // namespace lardhm
