/* Joint-limit stops; the rules are those of plant/stops.py. Without a reaction a stop is a clamp: a
   joint is pressed while its own acceleration points into the limit. Rigid stops act on all joints;
   with E the unit vectors of joints at a limit, into the range,

       v⁺ = v + M⁻¹E Λ,          0 ≤ Λ ⟂ Eᵀv⁺ ≥ 0          at an impact
       q̈ = q̈_free + M⁻¹E λ,      0 ≤ λ ⟂ Eᵀq̈ ≥ 0           while at rest

   Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 11.1 to 11.5. */
#include "stops.h"

#include <math.h>
#include <string.h>

enum { MOST_PIVOTS = 100 };

/* Joints at a limit; the sign of the way back into the range, 0 where there is no range. */
typedef struct {
    int count, joint[N_JOINTS];
    double side[N_JOINTS];
} Contacts;

static void find_contacts(const Plant *plant, const double q[N_JOINTS], Contacts *contacts)
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    contacts->count = 0;
    for (int i = 0; i < N_JOINTS; i++)
        if (RE(q[i]) >= RE(high[i]) || RE(q[i]) <= RE(low[i])) {
            contacts->side[contacts->count] =
                low[i] == high[i] ? 0.0 : RE(q[i]) >= RE(high[i]) ? -1.0 : 1.0;
            contacts->joint[contacts->count++] = i;
        }
}

/* z of the chosen contacts, so that b + W z = 0 there; others are 0. W is given by its columns. */
static void solve(const Contacts *contacts, const int active[N_JOINTS],
                  double columns[N_JOINTS][N_JOINTS], const double b[N_JOINTS],
                  double z[N_JOINTS])
{
    double A[N_JOINTS][N_JOINTS + 1];
    int chosen[N_JOINTS], n = 0;
    for (int k = 0; k < contacts->count; k++) {
        z[k] = 0.0;
        if (active[k])
            chosen[n++] = k;
    }
    for (int r = 0; r < n; r++) {
        for (int c = 0; c < n; c++)
            A[r][c] = columns[chosen[c]][contacts->joint[chosen[r]]];
        A[r][n] = -b[contacts->joint[chosen[r]]];
    }
    for (int p = 0; p < n; p++) /* a positive definite matrix needs no pivots */
        for (int r = p + 1; r < n; r++) {
            const double factor = A[r][p] / A[p][p];
            for (int c = p; c <= n; c++)
                A[r][c] -= factor * A[p][c];
        }
    for (int r = n - 1; r >= 0; r--) {
        double rest = A[r][n];
        for (int c = r + 1; c < n; c++)
            rest -= A[r][c] * z[chosen[c]];
        z[chosen[r]] = rest / A[r][r];
    }
}

/* z of each contact: 0 ≤ E z ⟂ E (b + W z) ≥ 0; of those that are fixed b + W z = 0, whichever way z
   points. Least-index pivoting ends for every positive definite W. Source: Murty, Opsearch 11,
   1974. */
static void complementary(const Contacts *contacts, const int fixed[N_JOINTS],
                          double columns[N_JOINTS][N_JOINTS], const double b[N_JOINTS],
                          int active[N_JOINTS], double z[N_JOINTS])
{
    for (int k = 0; k < contacts->count; k++)
        active[k] = fixed[k] || RE(contacts->side[k] * b[contacts->joint[k]]) < 0.0;
    for (int pivot = 0; pivot < MOST_PIVOTS; pivot++) {
        int wrong = -1;
        solve(contacts, active, columns, b, z);
        for (int k = 0; k < contacts->count && wrong < 0; k++) {
            double w = b[contacts->joint[k]];
            for (int c = 0; c < contacts->count; c++)
                w += columns[c][contacts->joint[k]] * z[c];
            if (!fixed[k] && RE(contacts->side[k] * (active[k] ? z[k] : w)) < 0.0)
                wrong = k;
        }
        if (wrong < 0)
            break;
        active[wrong] = !active[wrong];
    }
}

/* sum += W z */
static void add_reaction(const Contacts *contacts, double columns[N_JOINTS][N_JOINTS],
                         const double z[N_JOINTS], double sum[N_JOINTS])
{
    for (int k = 0; k < contacts->count; k++)
        for (int i = 0; i < N_JOINTS; i++)
            sum[i] += columns[k][i] * z[k];
}

void impact(const Plant *plant, double y[N_STATES], const int kept[N_JOINTS])
{
    Contacts contacts;
    double *v = y + N_JOINTS, z[N_JOINTS], columns[N_JOINTS][N_JOINTS];
    int into[N_JOINTS], fixed[N_JOINTS], any = 0;
    find_contacts(plant, y, &contacts);
    for (int k = 0; k < contacts.count; k++) {
        const double speed = v[contacts.joint[k]];
        fixed[k] = contacts.side[k] == 0.0;
        into[k] = fixed[k] ? speed != 0.0 : RE(contacts.side[k] * speed) < 0.0;
        any |= into[k];
        fixed[k] |= kept[contacts.joint[k]];
    }
    if (!any)
        return;
    if (plant->value[RIGID_STOPS] != 0.0) {
        inverse_mass(plant, y, contacts.count, contacts.joint, columns);
        complementary(&contacts, fixed, columns, v, into, z);
        add_reaction(&contacts, columns, z, v);
        for (int k = 0; k < contacts.count; k++)
            into[k] = z[k] != 0.0;
    }
    for (int k = 0; k < contacts.count; k++)
        if (into[k])
            v[contacts.joint[k]] = 0.0;
}

void hold(const Plant *plant, const double y[N_STATES], double a[N_JOINTS],
          const int kept[N_JOINTS], Stops *stops)
{
    Contacts contacts;
    const double *v = y + N_JOINTS;
    double z[N_JOINTS], columns[N_JOINTS][N_JOINTS], pressed[N_JOINTS];
    int fixed[N_JOINTS], active[N_JOINTS], count = 0;
    memset(stops, 0, sizeof *stops);
    find_contacts(plant, y, &contacts);
    for (int k = 0; k < contacts.count; k++) /* of those that rest */
        if (v[contacts.joint[k]] == 0.0) {
            contacts.joint[count] = contacts.joint[k];
            contacts.side[count] = contacts.side[k];
            fixed[count] = kept[contacts.joint[k]] || contacts.side[k] == 0.0;
            active[count] = fixed[count] || RE(contacts.side[k] * a[contacts.joint[k]]) <= 0.0;
            count++;
        }
    contacts.count = count;
    if (plant->value[RIGID_STOPS] != 0.0 && count > 0) {
        inverse_mass(plant, y, count, contacts.joint, columns);
        complementary(&contacts, fixed, columns, a, active, z);
        for (int k = 0; k < count; k++) {
            double stopped = a[contacts.joint[k]];
            for (int c = 0; c < count; c++)
                stopped += columns[c][contacts.joint[k]] * z[c];
            active[k] = fixed[k] || z[k] != 0.0 || stopped == 0.0;
        }
    }
    for (int k = 0; k < count; k++) {
        const int i = contacts.joint[k];
        stops->held[i] = active[k];
        stops->watched[i] = active[k] && !kept[i] && contacts.side[k] != 0.0;
        stops->any_held |= stops->held[i];
        stops->any_watched |= stops->watched[i];
    }
    restrain(plant, stops, y, a, pressed);
}

int is_above(const Plant *plant, double q, int i)
{
    return RE(plant->value[Q_MAX + i] - q) <= RE(q - plant->value[Q_MIN + i]);
}

void restrain(const Plant *plant, const Stops *stops, const double q[N_JOINTS], double a[N_JOINTS],
              double pressed[N_JOINTS])
{
    const int rigid = plant->value[RIGID_STOPS] != 0.0;
    Contacts contacts;
    double z[N_JOINTS], columns[N_JOINTS][N_JOINTS];
    int active[N_JOINTS];
    contacts.count = 0;
    if (!stops->any_held)
        return;
    for (int i = 0; i < N_JOINTS; i++)
        if (stops->held[i]) {
            active[contacts.count] = 1;
            contacts.joint[contacts.count++] = i;
        }
    if (rigid) {
        inverse_mass(plant, q, contacts.count, contacts.joint, columns);
        solve(&contacts, active, columns, a, z);
        add_reaction(&contacts, columns, z, a);
    }
    for (int k = 0; k < contacts.count; k++) {
        const int i = contacts.joint[k];
        const double outwards = is_above(plant, q[i], i) ? 1.0 : -1.0;
        pressed[i] = outwards * (rigid ? -z[k] : a[i]);
        a[i] = 0.0;
    }
}

void compute_rates(Plant *plant, const Stops *stops)
{
    double *value = plant->value, pressed[N_JOINTS];
    memcpy(&value[DER_Q], &value[V], N_JOINTS * sizeof *value);
    acceleration(plant, &value[Q], &value[V], &value[DER_V]);
    restrain(plant, stops, &value[Q], &value[DER_V], pressed);
}
