// Rays that pass through patches of hits, as in `crossings`: a balanced k-d tree of the hits, and rays
// followed through the boxes of its leaves.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "simd.h"
#include "tensors.h"
#include "threads.h"

namespace lardhm::passages {
namespace {

constexpr int64_t kRaysPerTask = 256;
constexpr double kSlow = 1e-30;  // directions smaller than this count as this

const double* doubles(const Tensor& tensor) { return in<double>(tensor); }

template <int D>
int widest_axis(const double* points, const int64_t* rows, int64_t count) {
  double low[D], high[D];
  for (int d = 0; d < D; ++d) {
    low[d] = std::numeric_limits<double>::infinity();
    high[d] = -low[d];
  }
  for (int64_t i = 0; i < count; ++i)
    for (int d = 0; d < D; ++d) {
      const double x = points[rows[i] * D + d];
      low[d] = std::min(low[d], x);
      high[d] = std::max(high[d], x);
    }
  int widest = 0;
  for (int d = 1; d < D; ++d)
    if (high[d] - low[d] > high[widest] - low[widest]) widest = d;
  return widest;
}

// Divides the nodes of one level after another; a leaf's rows ascend in the end.
template <int D>
void divide(const double* points, int64_t count, int64_t levels, int64_t* order) {
  const auto bound = [&](int64_t node, int64_t level) { return node * count >> level; };
  for (int64_t i = 0; i < count; ++i) order[i] = i;
  for (int64_t level = 0; level < levels; ++level)
    run_tasks(int64_t(1) << level, [&](int64_t node) {
      int64_t* first = order + bound(node, level);
      int64_t* stop = order + bound(node + 1, level);
      if (stop - first < 2) return;
      const int axis = widest_axis<D>(points, first, stop - first);
      std::nth_element(first, order + bound(2 * node + 1, level + 1), stop,
                       [&](int64_t a, int64_t b) {
                         const double x = points[a * D + axis], y = points[b * D + axis];
                         return x != y ? x < y : a < b;
                       });
    });
  run_tasks(int64_t(1) << levels, [&](int64_t leaf) {
    std::sort(order + bound(leaf, levels), order + bound(leaf + 1, levels));
  });
}

Tensor balanced_order(const Tensor& given, int64_t levels) {
  const Tensor points = tidy(given);
  check(points.dim() == 2 && (points.size(1) == 2 || points.size(1) == 3) &&
            points.scalar_type() == ScalarType::Double,
        "points must be (N, 2) or (N, 3), float64");
  check(levels >= 0 && levels < 40, "levels must be 0 to 39");
  const int64_t count = points.size(0);
  const Tensor order = new_empty(points, {count}, ScalarType::Long);
  if (points.size(1) == 2)
    divide<2>(doubles(points), count, levels, out<int64_t>(order));
  else
    divide<3>(doubles(points), count, levels, out<int64_t>(order));
  return order;
}

template <int D>
struct Box {
  double low[D], high[D];
};

template <int D>
struct Patch {
  double mean[D], precision[D * D], normal[D], clear;
};

template <int D>
double dot(const double* a, const double* b) {
  double sum = 0;
  for (int d = 0; d < D; ++d) sum += a[d] * b[d];
  return sum;
}

template <int D>
struct Ray {
  double start[D], ahead[D], inverse[D], reach, end;

  bool meets(const Box<D>& box) const {
    double enter = 0, leave = end;
    for (int d = 0; d < D; ++d) {
      const double one = (box.low[d] - start[d]) * inverse[d];
      const double other = (box.high[d] - start[d]) * inverse[d];
      enter = std::max(enter, std::min(one, other));
      leave = std::min(leave, std::max(one, other));
    }
    return enter <= leave;
  }

  bool passes(const Patch<D>& patch, double limit) const {
    double offset[D], scaled[D], apart[D];
    for (int d = 0; d < D; ++d) offset[d] = patch.mean[d] - start[d];
    const double before = -dot<D>(offset, patch.normal);
    const double after = before + reach * dot<D>(ahead, patch.normal);
    if (!(std::min(before, after) < -patch.clear && std::max(before, after) > patch.clear))
      return false;
    for (int d = 0; d < D; ++d) scaled[d] = dot<D>(patch.precision + d * D, ahead);
    const double depth = dot<D>(scaled, offset) / dot<D>(scaled, ahead);
    if (!(depth > 0 && depth < end)) return false;
    for (int d = 0; d < D; ++d) apart[d] = offset[d] - depth * ahead[d];
    double squared = 0;
    for (int d = 0; d < D; ++d) squared += apart[d] * dot<D>(patch.precision + d * D, apart);
    return squared < limit * limit;
  }
};

// Eight boxes, a register for each bound, a little larger than their originals: single precision
// excludes only boxes that double precision excludes, too.
using Eight = Vectors<float, 32>;

template <int D>
struct Boxes {
  Eight::V low[D], high[D];
};

template <int D>
struct Sight {  // a ray in single precision
  Eight::V start[D], inverse[D];
  float end;

  explicit Sight(const Ray<D>& ray) : end(float(ray.end * (1 + 1e-6))) {
    for (int d = 0; d < D; ++d) {
      start[d] = Eight::V{} + float(ray.start[d]);
      inverse[d] = Eight::V{} + float(ray.inverse[d]);
    }
  }

  // One bit for each box that the ray meets.
  uint32_t meets(const Boxes<D>& boxes) const {
    Eight::V enter = {}, leave = Eight::V{} + end;
    for (int d = 0; d < D; ++d) {
      const Eight::V one = (boxes.low[d] - start[d]) * inverse[d];
      const Eight::V other = (boxes.high[d] - start[d]) * inverse[d];
      enter = vmax(enter, vmin(one, other));
      leave = vmin(leave, vmax(one, other));
    }
    return bits_le<Eight::I>(enter <= leave, Eight::I{} - 1);
  }
};

// The boxes of a tree whose nodes have eight children each; the root has fewer.
template <int D>
class Forest {
  std::vector<std::vector<Boxes<D>>> levels;  // from the children of the root to the leaves
  std::vector<Box<D>> leaves;
  std::vector<Patch<D>> patches;

  // Boxes in groups of eight. A bound is moved out by what a float may be wrong there.
  static std::vector<Boxes<D>> grouped(const std::vector<Box<D>>& boxes, double far) {
    constexpr double kRounding = 4e-6;
    std::vector<Boxes<D>> groups((boxes.size() + 7) / 8);
    for (size_t i = 0; i < 8 * groups.size(); ++i)
      for (int d = 0; d < D; ++d) {
        constexpr double kNowhere = 1e30;  // no ray meets what fills the last group
        const bool is_box = i < boxes.size();
        const double low = is_box ? boxes[i].low[d] : kNowhere;
        const double high = is_box ? boxes[i].high[d] : kNowhere;
        const double slack = is_box ? kRounding * (far + std::max(std::abs(low), std::abs(high))) : 0;
        groups[i / 8].low[d][i % 8] = float(low - slack);
        groups[i / 8].high[d][i % 8] = float(high + slack);
      }
    return groups;
  }

 public:
  // `far`: largest coordinate of a ray's start.
  Forest(const Tensor& low, const Tensor& high, const Tensor& means, const Tensor& precisions,
         const Tensor& normals, const Tensor& clear, double far)
      : leaves(low.size(0)), patches(low.size(0)) {
    const int64_t count = low.size(0);
    for (int64_t i = 0; i < count; ++i) {
      std::copy_n(doubles(low) + i * D, D, leaves[i].low);
      std::copy_n(doubles(high) + i * D, D, leaves[i].high);
      std::copy_n(doubles(means) + i * D, D, patches[i].mean);
      std::copy_n(doubles(precisions) + i * D * D, D * D, patches[i].precision);
      std::copy_n(doubles(normals) + i * D, D, patches[i].normal);
      patches[i].clear = doubles(clear)[i];
    }
    std::vector<Box<D>> boxes = leaves;
    levels.push_back(grouped(boxes, far));
    while (boxes.size() > 8) {
      for (size_t i = 0; i < boxes.size() / 8; ++i) {
        Box<D> whole = boxes[8 * i];
        for (int j = 1; j < 8; ++j)
          for (int d = 0; d < D; ++d) {
            whole.low[d] = std::min(whole.low[d], boxes[8 * i + j].low[d]);
            whole.high[d] = std::max(whole.high[d], boxes[8 * i + j].high[d]);
          }
        boxes[i] = whole;
      }
      boxes.resize(boxes.size() / 8);
      levels.insert(levels.begin(), grouped(boxes, far));
    }
  }

  // Appends the pairs of a ray, the patches in ascending order.
  void follow(const Ray<D>& ray, int64_t row, double limit,
              std::vector<std::pair<int64_t, int64_t>>& found) const {
    descend(ray, Sight<D>(ray), 0, 0, row, limit, found);
  }

 private:
  void descend(const Ray<D>& ray, const Sight<D>& sight, size_t level, int64_t group, int64_t row,
               double limit, std::vector<std::pair<int64_t, int64_t>>& found) const {
    for (uint32_t met = sight.meets(levels[level][group]); met; met &= met - 1) {
      const int64_t node = 8 * group + __builtin_ctz(met);
      if (level + 1 < levels.size())
        descend(ray, sight, level + 1, node, row, limit, found);
      else if (ray.meets(leaves[node]) && ray.passes(patches[node], limit))
        found.emplace_back(row, node);
    }
  }
};

using Pairs = std::vector<std::pair<int64_t, int64_t>>;

template <int D>
std::vector<Pairs> follow_all(const Forest<D>& forest, const Tensor& starts, const Tensor& ahead,
                              const Tensor& reach, const Tensor& ends, double limit) {
  const int64_t rays = ahead.size(0), tasks = (rays + kRaysPerTask - 1) / kRaysPerTask;
  const bool one_start = starts.size(0) == 1;
  std::vector<Pairs> found(tasks);
  run_tasks(tasks, [&](int64_t task) {
    const int64_t stop = std::min(rays, (task + 1) * kRaysPerTask);
    for (int64_t row = task * kRaysPerTask; row < stop; ++row) {
      Ray<D> ray;
      std::copy_n(doubles(starts) + (one_start ? 0 : row * D), D, ray.start);
      std::copy_n(doubles(ahead) + row * D, D, ray.ahead);
      for (int d = 0; d < D; ++d)
        ray.inverse[d] = 1 / (std::abs(ray.ahead[d]) > kSlow ? ray.ahead[d] : kSlow);
      ray.reach = doubles(reach)[row];
      ray.end = doubles(ends)[row];
      forest.follow(ray, row, limit, found[task]);
    }
  });
  return found;
}

void check_patches(const Tensor& ahead, const Tensor& low, const Tensor& high,
                   const Tensor& means, const Tensor& precisions, const Tensor& normals,
                   const Tensor& clear) {
  const int64_t count = low.size(0), dim = ahead.size(1);
  check(count > 0 && (count & (count - 1)) == 0, "patches must be a power of two");
  for (const Tensor* part : {&low, &high, &means, &normals})
    check(part->dim() == 2 && part->size(0) == count && part->size(1) == dim,
          "boxes, means and normals must be (L, D)");
  check(precisions.dim() == 3 && precisions.numel() == count * dim * dim && clear.dim() == 1 &&
            clear.size(0) == count,
        "precisions must be (L, D, D), distances (L,)");
}

std::array<Tensor, 2> passing(Tensor starts, Tensor ahead, Tensor reach, Tensor ends,
                                   Tensor low, Tensor high, Tensor means, Tensor precisions,
                                   Tensor normals, Tensor clear, double limit) {
  for (Tensor* part : {&starts, &ahead, &reach, &ends, &low, &high, &means, &precisions, &normals,
                       &clear}) {
    check(part->scalar_type() == ScalarType::Double, "all tensors must be float64");
    *part = tidy(*part);
  }
  const int64_t rays = ahead.size(0);
  check(ahead.dim() == 2 && (ahead.size(1) == 2 || ahead.size(1) == 3),
        "directions must be (R, 2) or (R, 3)");
  check(starts.dim() == 2 && starts.size(1) == ahead.size(1) &&
            (starts.size(0) == 1 || starts.size(0) == rays) && reach.numel() == rays &&
            ends.numel() == rays,
        "starts must be (R, D) or (1, D), depths (R,)");
  check_patches(ahead, low, high, means, precisions, normals, clear);
  const auto run = [&](auto dim) {
    double far = 0;
    for (int64_t i = 0; i < starts.numel(); ++i) far = std::max(far, std::abs(doubles(starts)[i]));
    const Forest<dim()> forest(low, high, means, precisions, normals, clear, far);
    return follow_all<dim()>(forest, starts, ahead, reach, ends, limit);
  };
  const std::vector<Pairs> found = ahead.size(1) == 2 ? run(std::integral_constant<int, 2>{})
                                                      : run(std::integral_constant<int, 3>{});
  int64_t count = 0, row = 0;
  for (const Pairs& part : found) count += int64_t(part.size());
  const Tensor which = new_empty(ahead, {count}, ScalarType::Long);
  const Tensor leaves = new_empty(ahead, {count}, ScalarType::Long);
  for (const Pairs& part : found)
    for (const auto& pair : part) {
      out<int64_t>(which)[row] = pair.first;
      out<int64_t>(leaves)[row++] = pair.second;
    }
  return {which, leaves};
}

}  // namespace
}  // namespace lardhm::passages

namespace lardhm {

std::vector<Operator> passages_operators() {
  return {
      {"balanced_order(Tensor points, int levels) -> Tensor", &boxed<passages::balanced_order>},
      {"passing(Tensor starts, Tensor ahead, Tensor reach, Tensor ends, Tensor low, Tensor high, "
       "Tensor means, Tensor precisions, Tensor normals, Tensor clear, float limit) -> (Tensor, "
       "Tensor)",
       &boxed<passages::passing>},
  };
}

}  // namespace lardhm
