// Tensors as the sources of the kernel see them. Only bindings.cpp includes torch's headers: they, and
// the wrappers that they generate for each operator, took a third of the time to compile the kernel.

#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

namespace lardhm {

// Numbered as in torch, see bindings.cpp.
enum class ScalarType : int8_t {
  Byte = 0, Char = 1, Int = 3, Long = 4, Float = 6, Double = 7, Bool = 11,
};

using Sizes = std::vector<int64_t>;

// A handle of one of torch's tensors, on the CPU; copies share it.
class Tensor {
 public:
  struct View {
    virtual ~View() = default;
    virtual void* mutable_data() const = 0;
    const void* data;
    const int64_t* sizes;
    int64_t dim, numel;
    ScalarType type;
    bool contiguous;
  };

  Tensor() = default;
  explicit Tensor(std::shared_ptr<const View> of) : view(std::move(of)) {}

  int64_t dim() const { return view->dim; }
  int64_t numel() const { return view->numel; }
  int64_t size(int64_t d) const {
    if (d >= view->dim) fail_dimension(d);
    return view->sizes[d];
  }
  Sizes sizes() const { return Sizes(view->sizes, view->sizes + view->dim); }
  ScalarType scalar_type() const { return view->type; }
  bool is_contiguous() const { return view->contiguous; }
  const void* const_data_ptr() const { return view->data; }
  void* mutable_data_ptr() const { return view->mutable_data(); }

 private:
  friend struct Held;
  [[noreturn]] void fail_dimension(int64_t d) const;

  std::shared_ptr<const View> view;
};

template <int N>
using Tensors = std::array<Tensor, N>;

// As the functions of torch of the same names; without a type, that of `like`.
Tensor new_empty(const Tensor& like, const Sizes& sizes);
Tensor new_empty(const Tensor& like, const Sizes& sizes, ScalarType type);
Tensor new_zeros(const Tensor& like, const Sizes& sizes);
Tensor new_zeros(const Tensor& like, const Sizes& sizes, ScalarType type);
Tensor contiguous(const Tensor& tensor);
Tensor fill(const Tensor& tensor, double value);

// An argument or result of an operator, as torch passes it (`StableIValue`).
using Slot = uint64_t;

template <class X>
X unbox(Slot slot);
template <>
Tensor unbox<Tensor>(Slot slot);
template <>
Sizes unbox<Sizes>(Slot slot);
template <>
int64_t unbox<int64_t>(Slot slot);
template <>
double unbox<double>(Slot slot);
template <>
bool unbox<bool>(Slot slot);

Slot box(const Tensor& tensor);
Slot box(bool value);
Slot box(int64_t value);

template <class Result>
void store(const Result& result, Slot* stack) {
  *stack = box(result);
}

template <size_t N>
void store(const std::array<Tensor, N>& results, Slot* stack) {
  for (const Tensor& result : results) *stack++ = box(result);
}

template <class Result, class... Arguments, size_t... Places>
void call(Result (*function)(Arguments...), Slot* stack, std::index_sequence<Places...>) {
  store(function(unbox<std::decay_t<Arguments>>(stack[Places])...), stack);
}

template <class Result, class... Arguments>
void call(Result (*function)(Arguments...), Slot* stack) {
  call(function, stack, std::index_sequence_for<Arguments...>{});
}

// An operator's function with arguments and results on a stack. Torch has checked the former against the
// schema, which must be that of the function.
template <auto function>
void boxed(Slot* stack, uint64_t, uint64_t) {
  call(function, stack);
}

struct Operator {
  const char* schema;  // or the name alone, if operators.py defines it
  void (*run)(Slot*, uint64_t, uint64_t);
};

}  // namespace lardhm
