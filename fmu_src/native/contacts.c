/* The contact problem: which joints rest at limits or by friction, and the efforts or impulses on them. */
#ifndef IS_COMPLEX
#include <math.h>

enum { MOST_PIVOTS = 10000, BLOCK_TRIES = 5 };
/* 2⁻⁴⁰: rounding error of a sum whose sign decides, relative to its terms. */
static const double ROUNDING_OF_SUM = 1.0 / 1099511627776.0;

/* A joint at a limit or at rest. */
typedef struct {
    int there;        /* whether an effort or impulse acts on it */
    int fixed;        /* whether the joint rests in any case, without bounds */
    double side;      /* at a limit, the sign of the direction into the range; else 0 */
    double low, high; /* bounds of the effort or impulse */
    int at;           /* active bound: −1 or 1; 0 if the joint rests */
} Contact;

static int has_no_range(const Plant *plant, int i)
{
    return plant->value[Q_MIN + i] == plant->value[Q_MAX + i];
}

/* Find the joints at limits; stops of joints without a range, and of those in on_hold, act in both directions. */
static void find_contacts(const Plant *plant, const double q[N_JOINTS], const int on_hold[N_JOINTS],
                          Contact contact[N_JOINTS])
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    for (int i = 0; i < N_JOINTS; i++) {
        const double side = q[i] >= high[i] ? -1.0 : q[i] <= low[i] ? 1.0 : 0.0;
        const Contact own = {.there = side != 0.0, .fixed = on_hold[i] || has_no_range(plant, i), .side = side,
                             .low = side < 0.0 ? -HUGE_VAL : 0.0, .high = side > 0.0 ? HUGE_VAL : 0.0};
        contact[i] = own;
    }
}

/* True if the stop of a joint acts against a velocity or an acceleration. */
static int is_pressed(const Contact *contact, double rate)
{
    return contact->there && (contact->fixed ? rate != 0.0 : contact->side * rate < 0.0);
}

static double bound(const Contact *contact)
{
    return contact->at < 0 ? contact->low : contact->at > 0 ? contact->high : 0.0;
}

/* The active bound that corrects a contact: a new one if the effort exceeds a bound, or if the rate has the wrong sign
   at a bound; otherwise the present one. */
static int mended(const Contact *contact, double acts, double rate, double slack)
{
    if (!contact->there || contact->fixed)
        return contact->at;
    if (contact->at)
        return contact->at * rate > slack ? 0 : contact->at;
    return acts < contact->low - slack ? -1 : acts > contact->high + slack ? 1 : 0;
}

/* Solve a linear complementarity problem for rate + M⁻¹z, with z within the contacts' bounds: the result is above 0
   only if z is at its lower bound, and below 0 only if z is at its upper bound. Each iteration changes all violated
   contacts (block pivoting). If their number does not decrease for some iterations, only the last one changes, which
   terminates for every positive definite M. A bound is exceeded if z is beyond it by more than the rounding error of
   the largest effort or impulse, which is in z or is `acting`. Returns whether a solution was found, with the
   rates and z.
   Sources: Júdice & Pires, Computers & Operations Research 21(5), 1994; Murty, Opsearch 11, 1974. */
static int complementary(const Plant *plant, const double q[N_JOINTS], Contact contact[N_JOINTS], double acting,
                         double rate[N_JOINTS], double z[N_JOINTS])
{
    double free[N_JOINTS], given[N_JOINTS], change[N_JOINTS] = {0};
    JointPosition joint[N_BODIES];
    EndBody end_body[N_LOADED];
    int fewest = N_JOINTS + 1, tries = BLOCK_TRIES, any = 0, count = 1, finite = isfinite(acting) != 0;
    for (int i = 0; i < N_JOINTS; i++) {
        contact[i].at = 0; /* most joints rest */
        free[i] = contact[i].there ? 0.0 : 1.0;
        any |= contact[i].there;
        finite &= isfinite(rate[i]) != 0;
    }
    if (any) {
        place_joints(q, joint);
        body(plant->value, 0, end_body);
    }
    for (int pivot = 0; any && finite && count > 0 && pivot < MOST_PIVOTS; pivot++) {
        int wrong[N_JOINTS], next[N_JOINTS];
        double largest = acting;
        count = 0;
        for (int i = 0; i < N_JOINTS; i++)
            given[i] = free[i] == 0.0 ? -rate[i] : bound(&contact[i]);
        hybrid_dynamics(joint, end_body, &plant->value[ARMATURE], free, given, change, z);
        for (int i = 0; i < N_JOINTS; i++)
            largest = fmax(largest, fabs(free[i] == 0.0 ? z[i] : given[i]));
        for (int i = 0; i < N_JOINTS; i++) {
            const double size = free[i] == 0.0 ? largest : fabs(rate[i]) + fabs(change[i]);
            next[i] = mended(&contact[i], z[i], rate[i] + change[i], ROUNDING_OF_SUM * size);
            if (next[i] != contact[i].at)
                wrong[count++] = i;
        }
        tries = count < fewest ? BLOCK_TRIES : tries - 1;
        fewest = count < fewest ? count : fewest;
        for (int k = tries > 0 || count == 0 ? 0 : count - 1; k < count; k++) {
            contact[wrong[k]].at = next[wrong[k]];
            free[wrong[k]] = next[wrong[k]] == 0 ? 0.0 : 1.0;
        }
    }
    for (int i = 0; i < N_JOINTS; i++)
        rate[i] = free[i] == 0.0 ? 0.0 : rate[i] + change[i];
    return !any || (finite && count == 0);
}
#endif
