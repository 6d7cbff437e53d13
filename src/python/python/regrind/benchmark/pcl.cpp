// Point-to-plane registration by the Point Cloud Library, for the benchmark.
//
// Reads from standard input: counts of target and source points (two 64-bit integers); the number of distances and the
// distances in mm; the start, 16 numbers; then points and normals of the target and points of the source; all as doubles.
// Writes the pose target_from_source, 16 doubles row by row, and the seconds of the registration.
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <vector>

#include <pcl/point_types.h>
#include <pcl/registration/icp.h>
#include <pcl/registration/transformation_estimation_point_to_plane_lls.h>

using Cloud = pcl::PointCloud<pcl::PointNormal>;

template <typename T>
std::vector<T> take(std::size_t count) {
    std::vector<T> values(count);
    if (std::fread(values.data(), sizeof(T), count, stdin) != count) std::exit(2);
    return values;
}

Cloud::Ptr cloud(const std::vector<double>& points, const std::vector<double>* normals) {
    Cloud::Ptr made(new Cloud);
    made->resize(points.size() / 3);
    for (std::size_t k = 0; k < made->size(); ++k) {
        auto& point = (*made)[k];
        point.x = points[3 * k], point.y = points[3 * k + 1], point.z = points[3 * k + 2];
        point.normal_x = normals ? (*normals)[3 * k] : 0;
        point.normal_y = normals ? (*normals)[3 * k + 1] : 0;
        point.normal_z = normals ? (*normals)[3 * k + 2] : 1;
    }
    return made;
}

int main() {
    const auto counts = take<std::int64_t>(3);
    const auto reaches = take<double>(counts[2]);
    const auto start = take<double>(16);
    const auto target = take<double>(3 * counts[0]);
    const auto normals = take<double>(3 * counts[0]);
    const auto source = take<double>(3 * counts[1]);
    const auto begun = std::chrono::steady_clock::now();
    using Registration = pcl::IterativeClosestPoint<pcl::PointNormal, pcl::PointNormal, double>;
    Registration registration;
    registration.setTransformationEstimation(
        Registration::TransformationEstimationPtr(new pcl::registration::TransformationEstimationPointToPlaneLLS<
                                                  pcl::PointNormal, pcl::PointNormal, double>));
    registration.setInputTarget(cloud(target, &normals));
    registration.setInputSource(cloud(source, nullptr));
    // Smaller steps than these are rounding of 32 bits, which moves the pose away again.
    registration.setMaximumIterations(1000);
    registration.setTransformationEpsilon(1e-10);
    registration.setEuclideanFitnessEpsilon(1e-9);
    Eigen::Matrix4d pose = Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>>(start.data());
    Cloud moved;
    for (const double reach : reaches) {
        registration.setMaxCorrespondenceDistance(reach);
        registration.align(moved, pose);
        pose = registration.getFinalTransformation();
    }
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - begun;
    const Eigen::Matrix<double, 4, 4, Eigen::RowMajor> rows = pose;
    std::fwrite(rows.data(), sizeof(double), 16, stdout);
    const double seconds = took.count();
    std::fwrite(&seconds, sizeof(double), 1, stdout);
}
