// Reads a marginal (sst-graph export RESULT --to gtsam) and tells its cost at calibrations given as text.
//
//   g++ -std=c++17 -I/usr/include/eigen3 marginal_reader.cpp -o marginal_reader   (Eigen, nlohmann/json)
//   ./marginal_reader marginal.json < poses.txt
//
// A line of poses.txt: the 12 numbers of T_camera_lidar's upper three rows, then time_offset_s. A line of
// the answer: the cost 0.5 d'Ld - g'd + 0.5 c there, then d (7) = [Logmap(T0^-1 T), offset - offset0].

#include <Eigen/Dense>
#include <cmath>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <nlohmann/json.hpp>
#include <stdexcept>
#include <string>

using Matrix7 = Eigen::Matrix<double, 7, 7>;
using Vector7 = Eigen::Matrix<double, 7, 1>;
using Json = nlohmann::json;

struct Marginal {
  Eigen::Matrix4d T0;  // p_camera = T_camera_lidar * p_lidar
  double offset0;      // t_lidar = t_camera_stamp + time_offset_s [s]
  Matrix7 information;  // order: rotation x y z [rad], translation x y z [m], offset [s]
  Vector7 vector;
  double constant;
};

template <int Rows, int Cols>
Eigen::Matrix<double, Rows, Cols> matrix(const Json& rows) {
  Eigen::Matrix<double, Rows, Cols> m;
  for (int i = 0; i < Rows; ++i)
    for (int k = 0; k < Cols; ++k) m(i, k) = Cols == 1 ? rows.at(i).get<double>() : rows.at(i).at(k).get<double>();
  return m;
}

Marginal read(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw std::runtime_error(path + ": cannot be opened");
  const Json j = Json::parse(file);
  if (j.at("format") != "sst-graph/marginal" || j.at("version") != 1)
    throw std::runtime_error(path + ": not an sst-graph/marginal of version 1");
  const Json& point = j.at("linearization_point");
  return {matrix<4, 4>(point.at("T_camera_lidar")), point.at("time_offset_s").get<double>(),
          matrix<7, 7>(j.at("information")), matrix<7, 1>(j.at("vector")), j.at("constant").get<double>()};
}

Eigen::Matrix3d skew(const Eigen::Vector3d& w) {
  Eigen::Matrix3d W;
  W << 0, -w.z(), w.y(), w.z(), 0, -w.x(), -w.y(), w.x(), 0;
  return W;
}

// Logmap of SE(3), rotation first: what gtsam's Pose3::Logmap gives.
Eigen::Matrix<double, 6, 1> logmap(const Eigen::Matrix4d& T) {
  const Eigen::AngleAxisd turn(Eigen::Matrix3d(T.topLeftCorner<3, 3>()));
  const double angle = turn.angle();
  const Eigen::Vector3d w = angle * turn.axis();
  const Eigen::Matrix3d W = skew(w);
  const double k =
      angle < 1e-4 ? 1.0 / 12.0 : 1.0 / (angle * angle) - (1.0 + std::cos(angle)) / (2.0 * angle * std::sin(angle));
  Eigen::Matrix<double, 6, 1> xi;
  xi << w, (Eigen::Matrix3d::Identity() - 0.5 * W + k * W * W) * T.topRightCorner<3, 1>();
  return xi;
}

Vector7 step(const Marginal& m, const Eigen::Matrix4d& T, double offset) {
  Vector7 d;
  d << logmap(m.T0.inverse() * T), offset - m.offset0;
  return d;
}

int main(int argc, char** argv) try {
  if (argc != 2) throw std::runtime_error("usage: marginal_reader marginal.json < poses.txt");
  const Marginal m = read(argv[1]);
  std::cout << std::setprecision(17);
  Eigen::Matrix4d T = Eigen::Matrix4d::Identity();
  while (std::cin >> T(0, 0)) {
    double offset = 0.0;
    for (int i = 1; i < 12; ++i) std::cin >> T(i / 4, i % 4);
    if (!(std::cin >> offset)) throw std::runtime_error("a line of fewer than 13 numbers");
    const Vector7 d = step(m, T, offset);
    std::cout << 0.5 * d.dot(m.information * d) - m.vector.dot(d) + 0.5 * m.constant << ' ' << d.transpose() << '\n';
  }
} catch (const std::exception& error) {
  std::cerr << "marginal_reader: " << error.what() << '\n';
  return 2;
}
