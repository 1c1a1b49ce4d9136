/* CasADi's external functions `rates` and `jac_rates`: the FMU's right-hand side of state and efforts, and its
   Jacobian, each by one call of the engine, compiled in. */
#include "fmu_jacobian.c"

typedef long long Int;

/* Rows and columns; 1: dense, 0: empty. */
static const Int STATE[] = {STATES, 1, 1}, EFFORTS[] = {N, 1, 1}, NO_STATE[] = {STATES, 1, 0, 0};
static const Int BY_STATE[] = {STATES, STATES, 1}, BY_EFFORTS[] = {STATES, N, 1};

FMI2_Export Int rates_n_in(void) { return 2; }
FMI2_Export Int rates_n_out(void) { return 1; }
FMI2_Export const Int *rates_sparsity_in(Int i) { return i ? EFFORTS : STATE; }
FMI2_Export const Int *rates_sparsity_out(Int i) { return i ? NULL : STATE; }
FMI2_Export Int jac_rates_n_in(void) { return 3; }
FMI2_Export Int jac_rates_n_out(void) { return 2; }
FMI2_Export const Int *jac_rates_sparsity_in(Int i) { return i == 2 ? NO_STATE : rates_sparsity_in(i); }
FMI2_Export const Int *jac_rates_sparsity_out(Int i) { return i ? BY_EFFORTS : BY_STATE; }

static int set_arguments(const double **given)
{
    double point[3 * N];
    if (!arm && begin())
        return 1;
    memcpy(point, given[0], STATES * sizeof *point);
    memcpy(point + STATES, given[1], N * sizeof *point);
    return set_point(point);
}

FMI2_Export int rates(const double **given, double **result, Int *integers, double *reals, int memory)
{
    (void)integers, (void)reals, (void)memory;
    return set_arguments(given) || fmi2GetDerivatives(arm, result[0], STATES);
}

/* The columns of one argument; `first` is its first variable. */
static void set_columns(double slope[X][N], int first, int count, double *result)
{
    for (int c = 0; result && c < count; c++)
        for (int i = 0; i < N; i++) {
            *(result + c * STATES + i) = first == Q && c == N + i;
            *(result + c * STATES + N + i) = slope[first + c][i];
        }
}

FMI2_Export int jac_rates(const double **given, double **result, Int *integers, double *reals, int memory)
{
    double slope[X][N];
    (void)integers, (void)reals, (void)memory;
    if (set_arguments(given))
        return 1;
    update_rates(&arm->state);
    acceleration_slopes(&arm->state.plant, &arm->state.stops, slope);
    set_columns(slope, Q, STATES, result[0]);
    set_columns(slope, TAU_CMD, N, result[1]);
    return 0;
}
