/* Joint-limit stops; the rules are those of plant/stops.py. Without a reaction a stop is a clamp: a
   joint is pressed while its own acceleration points into the limit. Rigid stops act on all joints;
   with E the unit vectors of joints at a limit, into the range,

       v⁺ = v + M⁻¹E Λ,          0 ≤ Λ ⟂ Eᵀv⁺ ≥ 0          at an impact
       q̈ = q̈_free + M⁻¹E λ,      0 ≤ λ ⟂ Eᵀq̈ ≥ 0           while at rest

   Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 11.1 to 11.5. */
#include "stops.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

enum { MOST_PIVOTS = 10000, BLOCK_TRIES = 5 };
/* 2⁻⁴⁰: of the terms that a sign is the sum of, what rounding may leave of them. */
static const double ROUNDING_OF_SUM = 1.0 / 1099511627776.0;

#ifndef IS_COMPLEX
/* A joint at a limit. */
typedef struct {
    int there;   /* whether it is */
    int fixed;   /* whether its stop acts both ways */
    double side; /* the sign of the way back into the range */
} Contact;

/* The joints at limits; a joint without a range, and those in anti_chatter, have stops that act both ways. */
static void find_contacts(const Plant *plant, const double q[N_JOINTS], const int anti_chatter[N_JOINTS],
                          Contact contact[N_JOINTS])
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    for (int i = 0; i < N_JOINTS; i++) {
        contact[i].there = q[i] >= high[i] || q[i] <= low[i];
        contact[i].fixed = anti_chatter[i] || low[i] == high[i];
        contact[i].side = q[i] >= high[i] ? -1.0 : 1.0;
    }
}

/* Whether the stop of a joint acts on what has a rate, a velocity or an acceleration. */
static int is_pressed(const Contact *contact, double rate)
{
    return contact->there && (contact->fixed ? rate != 0.0 : contact->side * rate < 0.0);
}

/* z of the contacts and rate + M⁻¹z: 0 ≤ E z ⟂ E (rate + M⁻¹z) ≥ 0; of those that are fixed
   rate + M⁻¹z = 0, whichever way z points. All contacts that are wrong change sides at a time; where that
   does not lessen their number for a while only the last one does, which ends for every positive definite
   M. Sources: Júdice & Pires, Computers & Operations Research 21(5), 1994; Murty, Opsearch 11, 1974. */
static void complementary(const Plant *plant, const double q[N_JOINTS],
                          const Contact contact[N_JOINTS], double rate[N_JOINTS],
                          double z[N_JOINTS])
{
    double free[N_JOINTS], given[N_JOINTS], change[N_JOINTS] = {0};
    int fewest = N_JOINTS + 1, tries = BLOCK_TRIES, any = 0;
    memset(z, 0, N_JOINTS * sizeof *z);
    for (int i = 0; i < N_JOINTS; i++) {
        const int fixed = contact[i].there && contact[i].fixed;
        free[i] = fixed || is_pressed(&contact[i], rate[i]) ? 0.0 : 1.0;
        any |= free[i] == 0.0;
    }
    for (int pivot = 0; any && pivot < MOST_PIVOTS; pivot++) {
        int wrong[N_JOINTS], count = 0;
        double largest = 0.0;
        for (int i = 0; i < N_JOINTS; i++)
            given[i] = free[i] == 0.0 ? -rate[i] : 0.0;
        hybrid_motion(plant, q, free, given, change, z);
        for (int i = 0; i < N_JOINTS; i++)
            largest = fmax(largest, free[i] == 0.0 ? fabs(z[i]) : 0.0);
        for (int i = 0; i < N_JOINTS; i++) {
            const double sign = free[i] == 0.0 ? z[i] : rate[i] + change[i];
            const double size = free[i] == 0.0 ? largest : fabs(rate[i]) + fabs(change[i]);
            if (contact[i].there && !contact[i].fixed
                && contact[i].side * sign < -ROUNDING_OF_SUM * size)
                wrong[count++] = i;
        }
        if (count == 0)
            break;
        tries = count < fewest ? BLOCK_TRIES : tries - 1;
        fewest = count < fewest ? count : fewest;
        for (int k = tries > 0 ? 0 : count - 1; k < count; k++)
            free[wrong[k]] = 1.0 - free[wrong[k]];
        if (pivot == MOST_PIVOTS - 1) /* which no step accepts */
            change[0] = NAN;
    }
    for (int i = 0; i < N_JOINTS; i++) {
        rate[i] = free[i] == 0.0 ? 0.0 : rate[i] + change[i];
        z[i] = free[i] == 0.0 ? z[i] : 0.0;
    }
}

void impact(const Plant *plant, double y[N_STATES], const int anti_chatter[N_JOINTS])
{
    Contact contact[N_JOINTS];
    double *v = y + N_JOINTS, impulse[N_JOINTS];
    int any = 0;
    find_contacts(plant, y, anti_chatter, contact);
    for (int i = 0; i < N_JOINTS; i++)
        any |= is_pressed(&contact[i], v[i]);
    if (any && plant->value[RIGID_STOPS] != 0.0)
        complementary(plant, y, contact, v, impulse);
    else
        for (int i = 0; i < N_JOINTS; i++)
            if (is_pressed(&contact[i], v[i]))
                v[i] = 0.0;
}

void hold(const Plant *plant, const double y[N_STATES], double a[N_JOINTS],
          const int anti_chatter[N_JOINTS], Stops *stops, double pressed[N_JOINTS])
{
    const int rigid = plant->value[RIGID_STOPS] != 0.0;
    Contact contact[N_JOINTS];
    double stopped[N_JOINTS], reaction[N_JOINTS] = {0};
    *stops = (Stops){.rank = stops->rank};
    find_contacts(plant, y, anti_chatter, contact);
    for (int i = 0; i < N_JOINTS; i++)
        contact[i].there &= y[N_JOINTS + i] == 0.0; /* the others move away */
    memcpy(stopped, a, sizeof stopped);
    if (rigid)
        complementary(plant, y, contact, stopped, reaction);
    for (int i = 0; i < N_JOINTS; i++) {
        const int rests = rigid ? reaction[i] != 0.0 || stopped[i] == 0.0
                                : contact[i].side * a[i] <= 0.0;
        stops->held[i] = contact[i].there && (contact[i].fixed || rests);
        stops->watched[i] = stops->held[i] && !contact[i].fixed;
        stops->any_held |= stops->held[i];
        stops->any_watched |= stops->watched[i];
    }
    restrain(plant, stops, y, a, pressed);
}
#endif

int is_above(const Plant *plant, double q, int i)
{
    return RE(plant->value[Q_MAX + i] - q) <= RE(q - plant->value[Q_MIN + i]);
}

/* Rigid stops take the accelerations of held joints: their reactions. */
#ifdef IS_COMPLEX
/* By the columns of M⁻¹, which have derivatives. */
static void add_reactions(const Plant *plant, const Stops *stops, const double q[N_JOINTS],
                          double a[N_JOINTS], double reaction[N_JOINTS])
{
    double columns[N_JOINTS][N_JOINTS], A[N_JOINTS][N_JOINTS + 1];
    int held[N_JOINTS], n = 0;
    for (int i = 0; i < N_JOINTS; i++)
        if (stops->held[i])
            held[n++] = i;
    inverse_mass(plant, q, n, held, columns);
    for (int r = 0; r < n; r++) {
        for (int c = 0; c < n; c++)
            A[r][c] = columns[c][held[r]];
        A[r][n] = -a[held[r]];
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
            rest -= A[r][c] * reaction[held[c]];
        reaction[held[r]] = rest / A[r][r];
        for (int i = 0; i < N_JOINTS; i++)
            a[i] += columns[r][i] * reaction[held[r]];
    }
}
#else
static void add_reactions(const Plant *plant, const Stops *stops, const double q[N_JOINTS],
                          double a[N_JOINTS], double reaction[N_JOINTS])
{
    double free[N_JOINTS], given[N_JOINTS], change[N_JOINTS];
    for (int i = 0; i < N_JOINTS; i++) {
        free[i] = stops->held[i] ? 0.0 : 1.0;
        given[i] = stops->held[i] ? -a[i] : 0.0;
    }
    hybrid_motion(plant, q, free, given, change, reaction);
    for (int i = 0; i < N_JOINTS; i++)
        a[i] += change[i];
}
#endif

void restrain(const Plant *plant, const Stops *stops, const double q[N_JOINTS], double a[N_JOINTS],
              double pressed[N_JOINTS])
{
    const int rigid = plant->value[RIGID_STOPS] != 0.0;
    double reaction[N_JOINTS];
    if (!stops->any_held)
        return;
    if (rigid)
        add_reactions(plant, stops, q, a, reaction);
    for (int i = 0; i < N_JOINTS; i++)
        if (stops->held[i]) {
            const double outwards = is_above(plant, q[i], i) ? 1.0 : -1.0;
            pressed[i] = outwards * (rigid ? -reaction[i] : a[i]);
            a[i] = 0.0;
        }
}

void compute_rates(Plant *plant, const Stops *stops)
{
    double *value = plant->value, pressed[N_JOINTS];
    memcpy(&value[DER_Q], &value[V], N_JOINTS * sizeof *value);
    acceleration(plant, &value[Q], &value[V], stops->rank, &value[DER_V], NULL);
    restrain(plant, stops, &value[Q], &value[DER_V], pressed);
}
