// The peer of the batch adjustment: the same residuals in Ceres, automatic derivatives, sparse Schur complement.
//
//   adjust PROBLEM THREADS suite|eigen
//
// PROBLEM is what bench/ceres/compare.py writes: little-endian, counts as int64, then arrays. Prints one line of JSON.

#include <ceres/ceres.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <string>
#include <vector>

namespace {

struct Ray {
  double measured[2];    // mm, reduced to the principal point
  double pose[6];        // measured orientation
  double focal;          // mm
  double whiten[3];      // lower triangle 11, 21, 22
  double coefficient[4]; // of the nodes
  double camera[20];     // effect of ten additional parameters on x, then on y
};

template <typename T>
void project(const Ray& ray, const T* eo, const T* point, T* xy) {
  using std::cos;
  using std::sin;
  const T so = sin(eo[3]), co = cos(eo[3]), sp = sin(eo[4]), cp = cos(eo[4]), sk = sin(eo[5]), ck = cos(eo[5]);
  const T d0 = point[0] - eo[0], d1 = point[1] - eo[1], d2 = point[2] - eo[2];
  const T u1 = co * d1 + so * d2, u2 = co * d2 - so * d1;
  const T v0 = cp * d0 - sp * u2, v2 = sp * d0 + cp * u2;
  const T f0 = ck * v0 + sk * u1, f1 = ck * u1 - sk * v0;
  const T a = -ray.focal / v2;
  xy[0] = a * f0;
  xy[1] = a * f1;
}

template <typename T>
void finish(const Ray& ray, const T* eo, const T* common, const T* line, const T* point, T* residual) {
  T xy[2];
  project(ray, eo, point, xy);
  T r[2];
  for (int c = 0; c < 2; ++c) {
    r[c] = ray.measured[c] - xy[c];
    if (common != nullptr) {
      for (int k = 0; k < 6; ++k) r[c] -= ray.camera[10 * c + k] * common[k];
      for (int k = 0; k < 4; ++k) r[c] -= ray.camera[10 * c + 6 + k] * line[k];
    }
  }
  residual[0] = ray.whiten[0] * r[0];
  residual[1] = ray.whiten[1] * r[0] + ray.whiten[2] * r[1];
}

template <typename T>
void start(const Ray& ray, T* eo) {
  for (int c = 0; c < 6; ++c) eo[c] = T(ray.pose[c]);
}

struct Dgr {
  const Ray& ray;
  template <typename T>
  void orientation(const T* set, T* eo) const {
    start(ray, eo);
    for (int c = 0; c < 6; ++c) eo[c] += ray.coefficient[0] * set[c];
    for (int c = 0; c < 3; ++c) eo[3 + c] += ray.coefficient[1] * set[6 + c];
  }
  template <typename T>
  bool operator()(const T* set, const T* point, T* residual) const {
    T eo[6];
    orientation(set, eo);
    finish<T>(ray, eo, nullptr, nullptr, point, residual);
    return true;
  }
  template <typename T>
  bool operator()(const T* set, const T* common, const T* line, const T* point, T* residual) const {
    T eo[6];
    orientation(set, eo);
    finish<T>(ray, eo, common, line, point, residual);
    return true;
  }
};

struct Ppm {
  const Ray& ray;
  template <typename T>
  void orientation(const T* set, T* eo) const {
    start(ray, eo);
    for (int j = 0; j < 3; ++j)
      for (int c = 0; c < 6; ++c) eo[c] += ray.coefficient[j] * set[6 * j + c];
  }
  template <typename T>
  bool operator()(const T* set, const T* point, T* residual) const {
    T eo[6];
    orientation(set, eo);
    finish<T>(ray, eo, nullptr, nullptr, point, residual);
    return true;
  }
  template <typename T>
  bool operator()(const T* set, const T* common, const T* line, const T* point, T* residual) const {
    T eo[6];
    orientation(set, eo);
    finish<T>(ray, eo, common, line, point, residual);
    return true;
  }
};

struct Lim {
  const Ray& ray;
  template <typename T>
  void orientation(const T* a, const T* b, const T* c, const T* d, T* eo) const {
    start(ray, eo);
    for (int k = 0; k < 6; ++k)
      eo[k] += ray.coefficient[0] * a[k] + ray.coefficient[1] * b[k] + ray.coefficient[2] * c[k] +
               ray.coefficient[3] * d[k];
  }
  template <typename T>
  bool operator()(const T* a, const T* b, const T* c, const T* d, const T* point, T* residual) const {
    T eo[6];
    orientation(a, b, c, d, eo);
    finish<T>(ray, eo, nullptr, nullptr, point, residual);
    return true;
  }
  template <typename T>
  bool operator()(const T* a, const T* b, const T* c, const T* d, const T* common, const T* line, const T* point,
                  T* residual) const {
    T eo[6];
    orientation(a, b, c, d, eo);
    finish<T>(ray, eo, common, line, point, residual);
    return true;
  }
};

// residual = A x - b over some parameter blocks
class Linear : public ceres::CostFunction {
 public:
  Linear(std::vector<double> a, std::vector<double> b, const std::vector<int>& sizes)
      : a_(std::move(a)), b_(std::move(b)) {
    for (int size : sizes) {
      mutable_parameter_block_sizes()->push_back(size);
      width_ += size;
    }
    set_num_residuals(static_cast<int>(b_.size()));
  }
  bool Evaluate(double const* const* x, double* residual, double** jacobian) const override {
    int first = 0;
    for (size_t i = 0; i < b_.size(); ++i) residual[i] = -b_[i];
    for (size_t block = 0; block < parameter_block_sizes().size(); ++block) {
      const int size = parameter_block_sizes()[block];
      for (size_t i = 0; i < b_.size(); ++i)
        for (int j = 0; j < size; ++j) {
          const double value = a_[i * width_ + first + j];
          residual[i] += value * x[block][j];
          if (jacobian != nullptr && jacobian[block] != nullptr) jacobian[block][i * size + j] = value;
        }
      first += size;
    }
    return true;
  }

 private:
  std::vector<double> a_, b_;
  int width_ = 0;
};

template <typename T>
std::vector<T> read(FILE* file, int64_t count) {
  std::vector<T> values(count);
  if (std::fread(values.data(), sizeof(T), count, file) != static_cast<size_t>(count)) {
    std::fprintf(stderr, "problem file is too short\n");
    std::exit(1);
  }
  return values;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 4) {
    std::fprintf(stderr, "usage: adjust PROBLEM THREADS suite|eigen\n");
    return 2;
  }
  FILE* file = std::fopen(argv[1], "rb");
  if (file == nullptr) {
    std::fprintf(stderr, "cannot open %s\n", argv[1]);
    return 1;
  }
  // model: 0 DGR, 1 PPM, 2 LIM; blocks of the model, their size; additional parameters: 6 common + 4 a line
  const auto head = read<int64_t>(file, 7);
  const int64_t model = head[0], n_blocks = head[1], size = head[2], n_lines = head[3], n_points = head[4],
                n_rays = head[5], n_linear = head[6];
  std::vector<double> theta(n_blocks * size, 0.0), common(6, 0.0), lines(4 * n_lines, 0.0);
  auto points = read<double>(file, 3 * n_points);
  const auto block_of = read<int64_t>(file, n_rays), line_of = read<int64_t>(file, n_rays),
             point_of = read<int64_t>(file, n_rays);
  static_assert(sizeof(Ray) == 36 * sizeof(double));
  const auto rays = read<Ray>(file, n_rays);

  ceres::Problem::Options ownership;
  ceres::Problem problem(ownership);
  ceres::Solver::Options options;
  auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
  std::vector<double*> blocks;
  for (int64_t i = 0; i < n_blocks; ++i) blocks.push_back(&theta[i * size]);
  for (int64_t i = 0; i < n_points; ++i) ordering->AddElementToGroup(&points[3 * i], 0);
  for (double* block : blocks) ordering->AddElementToGroup(block, 1);
  if (n_lines > 0) {
    ordering->AddElementToGroup(common.data(), 1);
    for (int64_t i = 0; i < n_lines; ++i) ordering->AddElementToGroup(&lines[4 * i], 1);
  }
  for (int64_t i = 0; i < n_rays; ++i) {
    double* point = &points[3 * point_of[i]];
    double* line = n_lines > 0 ? &lines[4 * line_of[i]] : nullptr;
    double* const* b = &blocks[block_of[i]];
    const Ray& ray = rays[i];
    if (model == 0 && line == nullptr)
      problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Dgr, 2, 9, 3>(new Dgr{ray}), nullptr, b[0], point);
    else if (model == 0)
      problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Dgr, 2, 9, 6, 4, 3>(new Dgr{ray}), nullptr, b[0],
                               common.data(), line, point);
    else if (model == 1 && line == nullptr)
      problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Ppm, 2, 18, 3>(new Ppm{ray}), nullptr, b[0], point);
    else if (model == 1)
      problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Ppm, 2, 18, 6, 4, 3>(new Ppm{ray}), nullptr, b[0],
                               common.data(), line, point);
    else if (line == nullptr)
      problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Lim, 2, 6, 6, 6, 6, 3>(new Lim{ray}), nullptr, b[0],
                               b[1], b[2], b[3], point);
    else
      problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Lim, 2, 6, 6, 6, 6, 6, 4, 3>(new Lim{ray}), nullptr,
                               b[0], b[1], b[2], b[3], common.data(), line, point);
  }
  // linear equations: kind (0 model blocks, 1 point, 2 common, 3 line), rows, number of blocks, indices, A, b
  for (int64_t i = 0; i < n_linear; ++i) {
    const auto what = read<int64_t>(file, 3);
    const auto index = read<int64_t>(file, what[2]);
    std::vector<double*> x;
    std::vector<int> sizes;
    for (int64_t k : index) {
      x.push_back(what[0] == 0 ? blocks[k] : what[0] == 1 ? &points[3 * k] : what[0] == 2 ? common.data() : &lines[4 * k]);
      sizes.push_back(static_cast<int>(what[0] == 0 ? size : what[0] == 1 ? 3 : what[0] == 2 ? 6 : 4));
    }
    int width = 0;
    for (int s : sizes) width += s;
    auto a = read<double>(file, what[1] * width);
    auto b = read<double>(file, what[1]);
    problem.AddResidualBlock(new Linear(std::move(a), std::move(b), sizes), nullptr, x);
  }
  std::fclose(file);

  options.linear_solver_type = ceres::SPARSE_SCHUR;
  options.linear_solver_ordering = ordering;
  options.sparse_linear_algebra_library_type =
      std::string(argv[3]) == "eigen" ? ceres::EIGEN_SPARSE : ceres::SUITE_SPARSE;
  options.num_threads = std::atoi(argv[2]);
  options.function_tolerance = 1e-12;
  options.gradient_tolerance = 1e-30;
  options.parameter_tolerance = 1e-12;
  options.initial_trust_region_radius = 1e10;  // the starts are good: no damping, which spares Ceres iterations
  options.max_num_iterations = 100;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  std::printf("{\"cost\": %.15g, \"seconds\": %.6f, \"iterations\": %d, \"converged\": %s, \"theta\": [",
              2.0 * summary.final_cost, summary.total_time_in_seconds,
              static_cast<int>(summary.iterations.size()) - 1,
              summary.termination_type == ceres::CONVERGENCE ? "true" : "false");
  for (size_t i = 0; i < theta.size(); ++i) std::printf("%s%.15g", i ? ", " : "", theta[i]);
  std::printf("]}\n");
  return 0;
}
