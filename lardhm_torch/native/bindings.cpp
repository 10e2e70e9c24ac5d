// Between torch and the kernel: tensors, arguments and results, and the list of operators.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <stdexcept>
#include <string>

#include "tensor.h"

namespace lardhm {

namespace stable = torch::stable;
using TorchType = torch::headeronly::ScalarType;

template <ScalarType ours, TorchType torchs>
constexpr bool kSame = int(ours) == int(torchs);
static_assert(kSame<ScalarType::Byte, TorchType::Byte> && kSame<ScalarType::Char, TorchType::Char> &&
              kSame<ScalarType::Int, TorchType::Int> && kSame<ScalarType::Long, TorchType::Long> &&
              kSame<ScalarType::Float, TorchType::Float> && kSame<ScalarType::Bool, TorchType::Bool> &&
              kSame<ScalarType::Double, TorchType::Double>);

// A tensor of torch that outlives its views.
struct Held final : Tensor::View {
  stable::Tensor tensor;

  explicit Held(stable::Tensor given) : tensor(std::move(given)) {
    const auto lengths = tensor.sizes();
    data = tensor.const_data_ptr();
    sizes = lengths.data();
    dim = int64_t(lengths.size());
    numel = tensor.numel();
    type = ScalarType(tensor.scalar_type());
    contiguous = tensor.is_contiguous();
  }

  void* mutable_data() const override { return tensor.mutable_data_ptr(); }

  static Tensor hold(stable::Tensor given) {
    return Tensor(std::make_shared<const Held>(std::move(given)));
  }

  static const stable::Tensor& of(const Tensor& tensor) {
    return static_cast<const Held&>(*tensor.view).tensor;
  }
};

namespace {

torch::headeronly::IntHeaderOnlyArrayRef as_list(const Sizes& sizes) {
  return {sizes.data(), sizes.size()};
}

}  // namespace

void Tensor::fail_dimension(int64_t d) const {
  throw std::runtime_error("a tensor with " + std::to_string(view->dim) +
                           " dimensions has no dimension " + std::to_string(d));
}

Tensor new_empty(const Tensor& like, const Sizes& sizes) {
  return Held::hold(stable::new_empty(Held::of(like), as_list(sizes)));
}

Tensor new_empty(const Tensor& like, const Sizes& sizes, ScalarType type) {
  return Held::hold(stable::new_empty(Held::of(like), as_list(sizes), TorchType(type)));
}

Tensor new_zeros(const Tensor& like, const Sizes& sizes) {
  return Held::hold(stable::new_zeros(Held::of(like), as_list(sizes)));
}

Tensor new_zeros(const Tensor& like, const Sizes& sizes, ScalarType type) {
  return Held::hold(stable::new_zeros(Held::of(like), as_list(sizes), TorchType(type)));
}

Tensor contiguous(const Tensor& tensor) {
  if (tensor.is_contiguous()) return tensor;
  return Held::hold(stable::contiguous(Held::of(tensor)));
}

Tensor fill(const Tensor& tensor, double value) {
  stable::Tensor filled = Held::of(tensor);
  stable::fill_(filled, value);
  return tensor;
}

template <>
Tensor unbox<Tensor>(Slot slot) {
  return Held::hold(stable::detail::to<stable::Tensor>(slot));
}

template <>
Sizes unbox<Sizes>(Slot slot) {
  return stable::detail::to<Sizes>(slot);
}

template <>
int64_t unbox<int64_t>(Slot slot) {
  return stable::detail::to<int64_t>(slot);
}

template <>
double unbox<double>(Slot slot) {
  return stable::detail::to<double>(slot);
}

template <>
bool unbox<bool>(Slot slot) {
  return stable::detail::to<bool>(slot);
}

Slot box(const Tensor& tensor) { return stable::detail::from(Held::of(tensor)); }

Slot box(bool value) { return stable::detail::from(value); }

Slot box(int64_t value) { return stable::detail::from(value); }

#define LARDHM_SOURCES(USE)                                                                 \
  USE(axes) USE(cells) USE(descent) USE(evidence) USE(expected_range) USE(faces)            \
  USE(gradients) USE(kept) USE(kmeans) USE(marching) USE(mixture) USE(passages)             \
  USE(pooling) USE(query) USE(raycast) USE(ridge) USE(thinning) USE(tuning) USE(update)

// Each source that has operators lists them.
#define LARDHM_DECLARE(source) std::vector<Operator> source##_operators();
LARDHM_SOURCES(LARDHM_DECLARE)

namespace {

std::vector<Operator> all_operators() {
  std::vector<Operator> all;
#define LARDHM_APPEND(source) \
  for (const Operator& one : source##_operators()) all.push_back(one);
  LARDHM_SOURCES(LARDHM_APPEND)
  return all;
}

}  // namespace
}  // namespace lardhm

STABLE_TORCH_LIBRARY_FRAGMENT(lardhm, library) {
  for (const lardhm::Operator& one : lardhm::all_operators())
    if (std::string(one.schema).find('(') != std::string::npos) library.def(one.schema);
}

STABLE_TORCH_LIBRARY_IMPL(lardhm, CPU, library) {
  for (const lardhm::Operator& one : lardhm::all_operators()) {
    const std::string schema = one.schema;
    library.impl(schema.substr(0, schema.find('(')).c_str(), one.run);
  }
}
