// A marginal (sst-graph export RESULT --to gtsam) as a factor of a GTSAM graph in C++.
//
//   g++ -std=c++17 -I/usr/include/eigen3 marginal_factor.cpp -lgtsam -o marginal_factor   (GTSAM 4.3, nlohmann/json)
//   ./marginal_factor marginal.json < poses.txt
//
// A line of poses.txt: the 12 numbers of T_camera_lidar's upper three rows, then time_offset_s. A line of the
// answer: the factor's error there, then step (7) from the linearization point to the optimum of a graph that holds
// the factor alone, started there: [Logmap(T0^-1 T), offset - offset0].

#include <gtsam/geometry/Pose3.h>
#include <gtsam/inference/Symbol.h>
#include <gtsam/linear/HessianFactor.h>
#include <gtsam/nonlinear/LevenbergMarquardtOptimizer.h>
#include <gtsam/nonlinear/LinearContainerFactor.h>

#include <fstream>
#include <iomanip>
#include <iostream>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>

using namespace gtsam;
using Json = nlohmann::json;

Matrix matrix(const Json& rows) {
  Matrix m(rows.size(), rows.at(0).size());
  for (int i = 0; i < m.rows(); ++i)
    for (int k = 0; k < m.cols(); ++k) m(i, k) = rows.at(i).at(k).get<double>();
  return m;
}

// The calibration as a factor on extrinsic (Pose3) and time offset (Vector of size 1), with its linearization point.
LinearContainerFactor marginalFactor(const std::string& path, Key extrinsic, Key timeOffset, Values* point) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error(path + ": cannot be opened");
  const Json j = Json::parse(file);
  if (j.at("format") != "sst-graph/marginal" || j.at("version") != 1)
    throw std::runtime_error(path + ": not an sst-graph/marginal of version 1");
  const Json& at = j.at("linearization_point");
  point->insert(extrinsic, Pose3(matrix(at.at("T_camera_lidar"))));
  point->insert(timeOffset, Vector(Vector1(at.at("time_offset_s").get<double>())));
  const Matrix L = matrix(j.at("information"));
  const auto numbers = j.at("vector").get<std::vector<double>>();
  const Vector g = Eigen::Map<const Vector>(numbers.data(), 7);
  // The error of a HessianFactor is 0.5 d'Ld - d'g + 0.5 constant, as is the marginal's.
  const HessianFactor hessian(extrinsic, timeOffset, L.topLeftCorner(6, 6), L.topRightCorner(6, 1), g.head(6),
                              L.bottomRightCorner(1, 1), g.tail(1), j.at("constant").get<double>());
  return LinearContainerFactor(hessian, *point);
}

int main(int argc, char** argv) try {
  if (argc != 2) throw std::runtime_error("usage: marginal_factor marginal.json < poses.txt");
  const Key E = Symbol('E', 0), D = Symbol('D', 0);
  Values point;
  NonlinearFactorGraph graph;
  graph.push_back(marginalFactor(argv[1], E, D, &point));
  std::cout << std::setprecision(17);
  Matrix4 T = Matrix4::Identity();
  while (std::cin >> T(0, 0)) {
    double offset = 0.0;
    for (int i = 1; i < 12; ++i) std::cin >> T(i / 4, i % 4);
    if (!(std::cin >> offset)) throw std::runtime_error("a line of fewer than 13 numbers");
    Values values;
    values.insert(E, Pose3(T));
    values.insert(D, Vector(Vector1(offset)));
    const Values optimum = LevenbergMarquardtOptimizer(graph, values).optimize();
    const Vector turned = point.at<Pose3>(E).localCoordinates(optimum.at<Pose3>(E));
    const double later = optimum.at<Vector>(D)(0) - point.at<Vector>(D)(0);
    std::cout << graph.error(values) << ' ' << turned.transpose() << ' ' << later << '\n';
  }
} catch (const std::exception& error) {
  std::cerr << "marginal_factor: " << error.what() << '\n';
  return 2;
}
