/* Compare whole Jacobians at the same random points, and print the processor time of each way, s: a line for each
   round. Jacobians have columns by q, v and effort. */
#include <pinocchio/algorithm/aba-derivatives.hpp>

#include <cstdio>
#include <ctime>
#include <functional>
#include <random>
#include <vector>

#include "robot.hpp"

extern "C" {
int begin(void);
int by_rates(const double *point, double *result);
int by_calls(const double *point, double *result);
int by_engine(const double *point, double *result);
int of_aba(const double **given, double **result, long long *, double *, int);
int of_derivatives(const double **given, double **result, long long *, double *, int);
}

typedef Eigen::VectorXd Vector;
typedef Eigen::MatrixXd Matrix;
typedef std::function<void(const Vector &)> Way;

enum { POINTS = 64, ROUNDS = 60, PASSES = 10, OF_PINOCCHIO = 3 /* place of the way that the others must equal */ };

int main(int, char **argument)
{
    const pinocchio::Model model = robot(argument[1]);
    pinocchio::Data data(model);
    const int n = model.nv;
    Matrix result(n, 3 * n);
    int status = begin();
    std::mt19937 random(1);
    std::uniform_real_distribution<double> unit(-1.0, 1.0);
    std::vector<Vector> points;
    const auto coordinate = [&](int i) { return (i < n ? 3.0 : i < 2 * n ? 1.0 : 10.0) * unit(random); };
    for (int k = 0; k < POINTS; k++)
        points.push_back(Vector::NullaryExpr(3 * n, coordinate));
    double *to = result.data();
    const auto generated = [&](auto function, const Vector &point) {
        const double *given = point.data();
        status |= function(&given, &to, nullptr, nullptr, 0);
    };
    const auto pinocchio = [&](const Vector &point) {
        pinocchio::computeABADerivatives(model, data, point.head(n), point.segment(n, n), point.tail(n));
    };
    const std::vector<Way> ways = {
        [&](const Vector &point) { status |= by_rates(point.data(), to); },
        [&](const Vector &point) { status |= by_calls(point.data(), to); },
        [&](const Vector &point) { status |= by_engine(point.data(), to); },
        pinocchio,
        [&](const Vector &point) { generated(of_aba, point); },
        [&](const Vector &point) { generated(of_derivatives, point); },
    };
    double difference = 0.0;
    for (const Vector &point : points) {
        Matrix truth(n, 3 * n);
        pinocchio(point);
        truth << data.ddq_dq, data.ddq_dv, data.Minv;
        for (size_t way = 1; way < ways.size(); way++) {
            if (way == OF_PINOCCHIO)
                continue;
            result.setConstant(NAN);
            ways[way](point);
            const double here = (result - truth).cwiseAbs().maxCoeff() / truth.cwiseAbs().maxCoeff();
            difference = here <= difference ? difference : here; /* NaN stays */
        }
    }
    std::printf("%.3g\n", difference);
    for (int round = 0; round < ROUNDS; round++)
        for (size_t way = 0; way < ways.size(); way++) {
            timespec from, until;
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &from);
            for (int pass = 0; pass < PASSES; pass++)
                for (const Vector &point : points)
                    ways[way](point);
            clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &until);
            const double taken = (until.tv_sec - from.tv_sec) + 1e-9 * (until.tv_nsec - from.tv_nsec);
            std::printf(way + 1 < ways.size() ? "%.4g " : "%.4g\n", taken / (PASSES * POINTS));
        }
    return status;
}
