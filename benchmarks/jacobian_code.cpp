/* Print the C by CasADi of the Jacobian of the forward dynamics, from Pinocchio's algorithms. */
#include <pinocchio/autodiff/casadi.hpp>

#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>

#include "robot.hpp"

using casadi::SX;
typedef Eigen::Matrix<SX, Eigen::Dynamic, 1> Vector;

static Vector vector_of(const SX &sx)
{
    Vector vector(sx.rows());
    for (int i = 0; i < sx.rows(); i++)
        vector[i] = sx(i);
    return vector;
}

template <class Matrix> static SX sx_of(const Matrix &matrix)
{
    SX sx(matrix.rows(), matrix.cols());
    for (int i = 0; i < matrix.rows(); i++)
        for (int j = 0; j < matrix.cols(); j++)
            sx(i, j) = matrix(i, j);
    return sx;
}

int main(int, char **argument)
{
    const auto model = robot(argument[1]).cast<SX>();
    pinocchio::DataTpl<SX> data(model), derived(model);
    const SX point = SX::sym("point", 3 * model.nv);
    const Vector all = vector_of(point);
    const Vector q = all.head(model.nv), v = all.segment(model.nv, model.nv), tau = all.tail(model.nv);
    const SX a = sx_of(pinocchio::aba(model, data, q, v, tau, pinocchio::Convention::LOCAL));
    pinocchio::computeABADerivatives(model, derived, q, v, tau);
    const SX parts = SX::horzcat({sx_of(derived.ddq_dq), sx_of(derived.ddq_dv), sx_of(derived.Minv)});
    casadi::CodeGenerator code("rival.c", {{"with_header", false}});
    const casadi::Dict options = {{"cse", true}};
    code.add(casadi::Function("of_aba", {point}, {SX::densify(SX::jacobian(a, point))}, options));
    code.add(casadi::Function("of_derivatives", {point}, {SX::densify(parts)}, options));
    code.generate();
}
