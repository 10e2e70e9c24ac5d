// The nearest of many flat faces or plates, as `distance.py` defines them. A plate is a face with a
// thickness; inside of it the distance is negative.
//
// Packets of neighboring points search the tree in float32, the nearest child first, from a bound
// that the packet before gives. The distance and its gradient are then computed in float64 for the
// one face found.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

#include "face_tree.h"
#include "tensors.h"

namespace lardhm {
namespace {

constexpr int64_t kPointsPerTask = 1 << 15;  // sorted together

inline Simd<float>::V absolute(Simd<float>::V x) {
  return (Simd<float>::V)((Simd<float>::I)x & 0x7fffffff);
}

inline Simd<float>::V positive(Simd<float>::V x) {
  return x > 0 ? x : Simd<float>::V{};
}

inline Simd<float>::V root(Simd<float>::V x) {
#if defined(LARDHM_AVX512)
  return (Simd<float>::V)_mm512_sqrt_ps((__m512)x);
#elif defined(__AVX2__)
  return (Simd<float>::V)_mm256_sqrt_ps((__m256)x);
#else
  for (int lane = 0; lane < kFan; ++lane) x[lane] = std::sqrt(x[lane]);
  return x;
#endif
}

// A register of neighboring points on their way through the tree, one a lane.
template <int D, bool Solid>
struct Packet {
  using V = Simd<float>::V;
  using I = Simd<float>::I;
  const Tree<D>& tree;
  V x[D];
  V best;   // [m^2] squared distance of the nearest face so far; negative inside of a plate
  I found;  // its rank
  float low[D], high[D];

  explicit Packet(const Tree<D>& tree_) : tree(tree_) {}

  void start(float bound) {
    best = V{} + bound;
    found = I{} - 1;
    for (int d = 0; d < D; ++d) {
      low[d] = smallest_lane<float>(x[d]);
      high[d] = -smallest_lane<float>(-x[d]);
    }
  }

  void look_at(int64_t rank) {
    using L = FaceLayout<D>;
    const float* at = tree.leaves + rank * L::count;
    V offset[D], edge[D], lower{};
    for (int d = 0; d < D; ++d) offset[d] = x[d] - at[L::center + d];
    for (int j = 0; j < D; ++j) {
      V u = offset[0] * at[L::axes + j];
      for (int d = 1; d < D; ++d) u += offset[d] * at[L::axes + d * D + j];
      edge[j] = u;
      if (j) edge[j] = absolute(u) - at[L::half + j - 1];
      if (Solid && !j) edge[j] = absolute(u) - at[L::thickness];
      const V outside = j || Solid ? positive(edge[j]) : edge[j];
      lower += outside * outside;
    }
    if (!bits_of<float>(or_inside(lower) < best)) return;
    V squares{};
    for (int j = 1; j < D; ++j) {
      const V beyond = positive(edge[j] + at[L::radius]);
      squares += beyond * beyond;
    }
    const V side = root(squares) - at[L::radius], beside = positive(side);
    V distance = edge[0] * edge[0] + beside * beside;
    if (Solid) {
      const V above = positive(edge[0]), inside = edge[0] > side ? edge[0] : side;
      distance = inside > 0 ? above * above + beside * beside : -(inside * inside);
    }
    found = distance < best ? I{} + int32_t(rank) : found;
    best = distance < best ? distance : best;
  }

  // Bounds of squared distances: inside of a box there may be the inside of a plate.
  static V or_inside(V squared) {
    return Solid ? (squared > 0 ? squared : V{} - std::numeric_limits<float>::max()) : squared;
  }

  void visit(int64_t level, int64_t node) {
    const float* at = tree.boxes[level] + node * kFan * D * 2;
    V near{};  // of the packet's box, a child a lane
    for (int d = 0; d < D; ++d) {
      const V below = load<V>(at + d * kFan) - high[d], above = low[d] - load<V>(at + (D + d) * kFan);
      const V outside = positive(below > above ? below : above);
      near += outside * outside;
    }
    near = or_inside(near);
    for (;;) {
      const float least = smallest_lane<float>(near), worst = -smallest_lane<float>(-best);
      if (!(least < worst)) return;
      const int lane = __builtin_ctz(bits_of<float>(near == least));
      near[lane] = std::numeric_limits<float>::infinity();
      if (!reaches(at + lane)) continue;
      const int64_t child = node * kFan + lane;
      if (level) {
        visit(level - 1, child);
        continue;
      }
      const int64_t stop = std::min(tree.header.faces, (child + 1) * kFan);
      for (int64_t rank = child * kFan; rank < stop; ++rank) look_at(rank);
    }
  }

 private:
  // Whether a child's box is nearer to some point than what it has found.
  bool reaches(const float* at) const {
    V near{};
    for (int d = 0; d < D; ++d) {
      const V below = at[d * kFan] - x[d], above = x[d] - at[(D + d) * kFan];
      const V outside = positive(below > above ? below : above);
      near += outside * outside;
    }
    return bits_of<float>(or_inside(near) < best) != 0;
  }
};

// Signed distance to one face or plate, float64, and its gradient where asked.
template <int D>
double exact(const FaceArrays<D>& faces, int64_t face, const double* point, double* gradient) {
  const double* axes = faces.axis(face);
  const double radius = faces.radius(face);
  double u[D] = {}, beyond[D] = {}, slope[D] = {}, squares = 0;
  for (int d = 0; d < D; ++d) {
    const double offset = point[d] - faces.centers[face * D + d];
    for (int j = 0; j < D; ++j) u[j] += offset * axes[d * D + j];
  }
  for (int j = 1; j < D; ++j) {
    beyond[j] = std::max(std::abs(u[j]) - (faces.edges(face)[j - 1] - radius), 0.0);
    squares += beyond[j] * beyond[j];
  }
  const double length = std::sqrt(squares), side = length - radius;
  double height = u[0], up = 1, value;
  if (faces.thickness) {
    height = std::abs(u[0]) - faces.thickness[face];
    up = std::copysign(1.0, u[0]);
  }
  double part[2];  // of the height and of what is beside in the gradient
  if (faces.thickness && std::max(height, side) <= 0) {
    value = std::max(height, side);
    part[0] = height >= side, part[1] = height < side;
  } else if (side > 0 && !(faces.thickness && height <= 0)) {
    const double sign = !faces.thickness && -height > side ? -1.0 : 1.0;
    const double distance = std::sqrt(height * height + side * side);
    value = sign * distance;
    part[0] = sign * height / distance, part[1] = sign * side / distance;
  } else {
    value = side > 0 ? side : height;
    part[0] = side <= 0, part[1] = side > 0;
  }
  if (gradient) {
    slope[0] = part[0] * up;
    for (int j = 1; j < D; ++j)
      slope[j] = length > 0 ? part[1] * std::copysign(beyond[j] / length, u[j]) : 0.0;
    for (int d = 0; d < D; ++d) {
      gradient[d] = 0;
      for (int j = 0; j < D; ++j) gradient[d] += axes[d * D + j] * slope[j];
    }
  }
  return value;
}

// Answers for some points, in the order of a Z curve: a packet begins with the face of the one before.
template <int D>
struct Answer {
  const double* points;
  const Tree<D>& tree;
  const FaceArrays<D>& faces;
  double max_distance;
  double *values, *gradients;  // no gradients: null
  int64_t* nearest;

  void run(int64_t begin, int64_t end) const {
    faces.thickness ? search<true>(begin, end) : search<false>(begin, end);
  }

 private:
  template <bool Solid>
  void search(int64_t begin, int64_t end) const {
    const std::vector<int64_t> rows = sorted_rows(begin, end);
    Packet<D, Solid> packet(tree);
    int64_t last = 0;
    for (int64_t i = 0; i < int64_t(rows.size()); i += kFan) {
      const int lanes = int(std::min<int64_t>(kFan, int64_t(rows.size()) - i));
      float x[D][kFan];
      for (int lane = 0; lane < kFan; ++lane) {
        const double* point = points + rows[i + std::min(lane, lanes - 1)] * D;
        for (int d = 0; d < D; ++d) x[d][lane] = float(point[d] - tree.header.base[d]);
      }
      for (int d = 0; d < D; ++d) packet.x[d] = load<Simd<float>::V>(x[d]);
      packet.start(float(max_distance * max_distance * (1 + 1e-6)));
      if (tree.header.faces) {
        packet.look_at(last);
        packet.visit(tree.header.levels - 1, 0);
      }
      int32_t found[kFan];
      std::memcpy(found, &packet.found, sizeof(found));
      for (int lane = 0; lane < lanes; ++lane) finish(rows[i + lane], found[lane]);
      last = std::max(0, int(found[lanes - 1]));
    }
  }

  // The finite points along a Z curve; the others are answered at once.
  std::vector<int64_t> sorted_rows(int64_t begin, int64_t end) const {
    Box<double, D> box;
    box.add(points, begin, end, 1);
    double edges[D];
    for (int d = 0; d < D; ++d) {
      if (!(box.low[d] <= box.high[d])) box.low[d] = box.high[d] = 0;
      edges[d] = box.high[d] - box.low[d];
    }
    Sorter sorter;
    ZCurve<D>(edges, double(end - begin)).sort(points + begin * D, box.low, end - begin, sorter);
    std::vector<int64_t> rows;
    rows.reserve(end - begin);
    for (uint64_t item : sorter.items) {
      const int64_t row = begin + int64_t(uint32_t(item));
      if (is_finite(points + row * D, D))
        rows.push_back(row);
      else
        set(row, std::numeric_limits<double>::quiet_NaN(), -1);
    }
    return rows;
  }

  void set(int64_t row, double value, int64_t face) const {
    values[row] = value;
    nearest[row] = face;
    if (gradients && face < 0) std::fill_n(gradients + row * D, D, 0.0);
  }

  void finish(int64_t row, int64_t rank) const {
    if (rank < 0) return set(row, max_distance, -1);
    const int64_t face = tree.order[rank];
    const double value =
        exact<D>(faces, face, points + row * D, gradients ? gradients + row * D : nullptr);
    const bool is_near = (faces.thickness ? value : std::abs(value)) < max_distance;
    set(row, is_near ? value : max_distance, is_near ? face : -1);
  }
};

void check_faces(const Tensor& centers, const Tensor& axes, const Tensor& half,
                 const Tensor& thickness) {
  const int64_t count = centers.size(0), dim = centers.size(1);
  check(centers.dim() == 2 && (dim == 2 || dim == 3), "centers must be (F, 2) or (F, 3)");
  check(axes.dim() == 3 && axes.size(0) == count && axes.size(1) == dim && axes.size(2) == dim,
        "axes must be (F, D, D)");
  check(half.dim() == 2 && half.size(0) == count && half.size(1) == dim - 1,
        "half must be (F, D - 1)");
  check(thickness.dim() == 1 && (thickness.size(0) == 0 || thickness.size(0) == count),
        "thickness must be (F,), or (0,) for faces");
  for (const Tensor* t : {&centers, &axes, &half, &thickness})
    check(t->scalar_type() == ScalarType::Double, "faces must be float64");
  check(count < (int64_t(1) << 30), "faces must be fewer than 2^30");
}

template <int D>
FaceArrays<D> arrays_of(const Tensor& centers, const Tensor& axes, const Tensor& half,
                        const Tensor& thickness) {
  return {in<double>(centers), in<double>(axes), in<double>(half),
          thickness.size(0) ? in<double>(thickness) : nullptr};
}

template <class Use>
auto by_dimension(int64_t dim, const Use& use) {
  return dim == 2 ? use(std::integral_constant<int, 2>{}) : use(std::integral_constant<int, 3>{});
}

Tensor face_tree(const Tensor& given_centers, const Tensor& given_axes, const Tensor& given_half,
                 const Tensor& given_thickness) {
  const Tensor centers = tidy(given_centers), axes = tidy(given_axes), half = tidy(given_half);
  const Tensor thickness = tidy(given_thickness);
  check_faces(centers, axes, half, thickness);
  return by_dimension(centers.size(1), [&](auto dim) {
    const auto faces = arrays_of<dim()>(centers, axes, half, thickness);
    const TreeBuilder<dim()> builder(faces, centers.size(0));
    const Tensor bytes =
        new_empty(centers, {builder.header.bytes}, ScalarType::Byte);
    builder.write(out<char>(bytes));
    return bytes;
  });
}

Tensors<3> nearest_face(const Tensor& given_points, const Tensor& given_tree,
                        const Tensor& given_centers, const Tensor& given_axes,
                        const Tensor& given_half, const Tensor& given_thickness,
                        double max_distance, bool gradient) {
  const Tensor points = tidy(given_points), tree = tidy(given_tree);
  const Tensor centers = tidy(given_centers), axes = tidy(given_axes), half = tidy(given_half);
  const Tensor thickness = tidy(given_thickness);
  check_faces(centers, axes, half, thickness);
  check_rows("points", points, centers);
  const int64_t n = points.size(0), dim = points.size(1);
  TreeHeader header{};
  check(tree.scalar_type() == ScalarType::Byte && tree.numel() >= int64_t(sizeof(header)),
        "tree must be made by face_tree");
  std::memcpy(&header, tree.const_data_ptr(), sizeof(header));
  check(header.magic == kTreeMagic && header.bytes == tree.numel() && header.dim == dim &&
            header.fan == kFan && header.faces == centers.size(0),
        "tree must be made by face_tree of these faces");
  check(max_distance >= 0, "max_distance must be 0 or more");
  const Tensor values = new_empty(points, {n});
  const Tensor slopes = new_empty(points, {gradient ? n : 0, dim});
  const Tensor nearest = new_empty(points, {n}, ScalarType::Long);
  by_dimension(dim, [&](auto d) {
    const auto faces = arrays_of<d()>(centers, axes, half, thickness);
    const Tree<d()> search(in<char>(tree));
    const Answer<d()> answer{in<double>(points), search, faces, max_distance, out<double>(values),
                             gradient ? out<double>(slopes) : nullptr, out<int64_t>(nearest)};
    const int64_t share = (n + num_threads() - 1) / num_threads();
    const int64_t size = std::clamp<int64_t>(share, 1, kPointsPerTask);
    run_tasks((n + size - 1) / size,
              [&](int64_t task) { answer.run(task * size, std::min(n, (task + 1) * size)); });
    return 0;
  });
  return {values, slopes, nearest};
}

}  // namespace

std::vector<Operator> faces_operators() {
  return {
      {"face_tree(Tensor centers, Tensor axes, Tensor half, Tensor thickness) -> Tensor",
       &boxed<face_tree>},
      {"nearest_face(Tensor points, Tensor tree, Tensor centers, Tensor axes, Tensor half, "
       "Tensor thickness, float max_distance, bool gradient) -> (Tensor, Tensor, Tensor)",
       &boxed<nearest_face>},
  };
}

}  // namespace lardhm
