// Expected ranges of rays, as `collision.py` defines them by the sections of `marching.py`.

#include "rays.h"

namespace lardhm {
namespace {

// Length of the hazard [m], and the expected obstacles after which nothing is reached.
struct Survey : Steps {
  double length, most;

  // Probability to get through a section with `expected` obstacles after `before`, as `hazard.reached`.
  double reached(double expected, double before) const {
    const double within = expected < 1e-4 ? 1 - expected / 2 : -std::expm1(-expected) / expected;
    const double negligible = std::exp(-most);
    return std::max(std::exp(-before) * within - negligible, 0.0) / (1 - negligible);
  }

  double width(int64_t section) const { return depth(section + 1) - depth(section); }
};

// A ray whose hazard is integrated by the trapezoidal rule; steps that are passed over have none.
template <class T, int D>
struct Expectation : Ray<T, D> {
  using Ray<T, D>::next;
  int64_t at = 0;            // the last step of which the hazard is known
  double rate = 0, met = 0;  // there [1/m]; expected obstacles up to there
  double sum = 0;            // expected length up to there [m]

  void ask(const Survey& survey, std::vector<T>& points) const {
    for (int i = 0; i < kStride; ++i) this->place(survey.depth(next + i), points);
  }

  int take(const Survey& survey, const T* values) {
    for (int i = 0; i < kStride && next + i <= survey.last() && met < survey.most; ++i)
      advance(survey, next + i, std::max(double(values[i]), 0.0) / survey.length);
    next += kStride;
    this->skips = true;
    this->done = next >= this->stop || !(met < survey.most);
    return kStride;
  }

  double result(const Survey& survey) const {
    Expectation end = *this;
    if (met < survey.most) end.advance(survey, survey.last(), 0.0);
    return end.sum;
  }

 private:
  // Goes to a step where the hazard is given, past others without one.
  void advance(const Survey& survey, int64_t step, double hazard) {
    if (step > at + 2) {
      section(survey, at + 1, 0.0);
      sum += survey.reached(0, met) * (survey.depth(step - 1) - survey.depth(at));
      at = step - 1;
    }
    while (at + 1 < step) section(survey, at + 1, 0.0);
    if (step > at) section(survey, step, hazard);
    rate = hazard;
  }

  void section(const Survey& survey, int64_t end, double hazard) {
    const double width = survey.width(end - 1), expected = 0.5 * (rate + hazard) * width;
    sum += width * survey.reached(expected, met);
    met += expected;
    rate = hazard;
    at = end;
  }
};

Tensor expected_ranges(const Tensor& given_origins, const Tensor& given_ways, double step,
                       double max_range, double length, double passed, double negligible,
                       const Tensor& centers, const Tensor& raw, const Tensor& weights, int64_t k,
                       double covariance_scale, double min_lengthscale, const Tensor& index) {
  check_k(k);
  const Tensor origins = tidy(given_origins), ways = tidy(given_ways);
  const MapTensors map(centers, raw, weights, index, covariance_scale, min_lengthscale);
  const int64_t n = origins.size(0);
  check_rays(origins, ways, centers);
  check(length > 0 && negligible > 0 && negligible < 1, "length and negligible must be > 0");
  const Survey survey{{step, max_range, passed}, length, -std::log(negligible)};
  check_steps(survey);
  k = std::min(k, centers.size(0));
  const Tensor results = new_empty(origins, {n});
  if (k == 0) return fill(results, max_range);
  dispatch(centers, [&](auto type, auto dim) {
    using T = decltype(type);
    with_parameters<T, dim()>(map, kStride * n, [&](Parameters<T, dim()>& parameters) {
      march_all<T, dim(), Expectation<T, dim()>>(in<double>(origins), in<double>(ways), n, map, k,
                                                 survey, parameters, out<double>(results));
    });
    return 0;
  });
  return results;
}

}  // namespace

std::vector<Operator> expected_range_operators() {
  return {
      {"expected_ranges(Tensor origins, Tensor directions, float step, float max_range, "
       "float length, float passed, float negligible, Tensor centers, Tensor raw_scale_tril, "
       "Tensor weights, int k, float covariance_scale, float min_lengthscale, Tensor index) -> Tensor",
       &boxed<expected_ranges>},
  };
}

}  // namespace lardhm
