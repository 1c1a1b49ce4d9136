/* Joint-limit stops and friction by the equations of plant/stops.py. A stop without reaction is a clamp: a joint rests
   while its own acceleration points into the limit. A rigid stop acts on all joints, as friction does.

   Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 11.1 to 11.5; Pfeiffer & Glocker,
   "Multibody Dynamics with Unilateral Contacts", 1996, chapter 5. */
#include "stops.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

enum { MOST_PIVOTS = 10000, BLOCK_TRIES = 5 };
/* 2⁻⁴⁰: rounding error of a sum whose sign decides, relative to its terms. */
static const double ROUNDING_OF_SUM = 1.0 / 1099511627776.0;
static const double USUAL_RTOL = 1e-3;

/* The directions of slip in a regime; NULL if no joint slips. */
INTERNAL const int *slip_of(const Stops *stops)
{
    return stops->any_slip ? stops->slip : NULL;
}

/* True if a joint is nearer to its upper limit than to its lower one. */
INTERNAL int is_above(const Plant *plant, double q, int i)
{
    return RE(plant->value[Q_MAX + i] - q) <= RE(q - plant->value[Q_MIN + i]);
}

/* Hold joints by reactions, so that their accelerations are 0. */
static int reacts(const Stops *stops, int i)
{
    return stops->held[i] == STUCK || stops->held[i] == STOPPED;
}

#ifndef IS_COMPLEX
static int any_reacts(const Stops *stops)
{
    int any = 0;
    for (int i = 0; i < N_JOINTS && stops->any_held; i++)
        any |= reacts(stops, i);
    return any;
}

static void add_reactions(const Plant *plant, const Stops *stops, const double q[N_JOINTS],
                          double a[N_JOINTS], double reaction[N_JOINTS])
{
    double free[N_JOINTS], given[N_JOINTS], change[N_JOINTS];
    for (int i = 0; i < N_JOINTS; i++) {
        free[i] = reacts(stops, i) ? 0.0 : 1.0;
        given[i] = reacts(stops, i) ? -a[i] : 0.0;
    }
    hybrid_motion(plant, q, &plant->value[ARMATURE], free, given, change, reaction);
    for (int i = 0; i < N_JOINTS; i++)
        a[i] += change[i];
}
#endif

/* Hold joints, so that their acceleration a is 0; effort receives the holding efforts, for a clamp −q̈. */
INTERNAL void restrain(const Plant *plant, const Stops *stops, const double q[N_JOINTS], double a[N_JOINTS],
                       double effort[N_JOINTS])
{
    if (!stops->any_held)
        return;
#ifndef IS_COMPLEX
    if (any_reacts(stops))
        add_reactions(plant, stops, q, a, effort);
#else
    (void)plant, (void)q; /* derivatives with reactions are those of the Jacobian */
#endif
    for (int i = 0; i < N_JOINTS; i++)
        if (stops->held[i]) {
            effort[i] = reacts(stops, i) ? effort[i] : -a[i];
            a[i] = 0.0;
        }
}

#ifndef IS_COMPLEX
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

/* Find the joints at limits; stops of joints without a range, and of those in kept, act in both directions. */
static void find_contacts(const Plant *plant, const double q[N_JOINTS], const int kept[N_JOINTS],
                          Contact contact[N_JOINTS])
{
    const double *low = &plant->value[Q_MIN], *high = &plant->value[Q_MAX];
    for (int i = 0; i < N_JOINTS; i++) {
        const double side = q[i] >= high[i] ? -1.0 : q[i] <= low[i] ? 1.0 : 0.0;
        const Contact own = {.there = side != 0.0, .fixed = kept[i] || has_no_range(plant, i), .side = side,
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
   terminates for every positive definite M. Returns whether a solution was found, with the rates and z.
   Sources: Júdice & Pires, Computers & Operations Research 21(5), 1994; Murty, Opsearch 11, 1974. */
static int complementary(const Plant *plant, const double q[N_JOINTS], Contact contact[N_JOINTS],
                         double rate[N_JOINTS], double z[N_JOINTS])
{
    double free[N_JOINTS], given[N_JOINTS], change[N_JOINTS] = {0};
    int fewest = N_JOINTS + 1, tries = BLOCK_TRIES, any = 0, count = 1, finite = 1, bounded = 0;
    for (int i = 0; i < N_JOINTS; i++) {
        const int resists = contact[i].there && contact[i].high > 0.0 && contact[i].low < 0.0;
        const int rests = (contact[i].there && contact[i].fixed) || resists || is_pressed(&contact[i], rate[i]);
        contact[i].at = rests || !contact[i].there ? 0 : contact[i].side > 0.0 ? -1 : 1;
        free[i] = rests ? 0.0 : 1.0;
        any |= rests;
        bounded |= contact[i].there;
        finite &= isfinite(rate[i]) != 0;
    }
    for (int pivot = 0; any && finite && count > 0 && pivot < MOST_PIVOTS; pivot++) {
        int wrong[N_JOINTS], next[N_JOINTS];
        double largest = 0.0;
        count = 0;
        for (int i = 0; i < N_JOINTS; i++)
            given[i] = free[i] == 0.0 ? -rate[i] : bound(&contact[i]);
        hybrid_motion(plant, q, &plant->value[ARMATURE], free, given, change, z);
        for (int i = 0; i < N_JOINTS; i++)
            largest = fmax(largest, free[i] == 0.0 ? fabs(z[i]) : 0.0);
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
    return !bounded || (finite && (!any || count == 0));
}

/* Fraction of the times within which events at rigid stops are one: they shrink with rtol below its default. */
INTERNAL double coarseness(const Plant *plant)
{
    return fmin(1.0, plant->value[RTOL] / USUAL_RTOL);
}

/* Remove the velocity that points into a limit from the state y = (q, v). Joints in anti_chatter stop in both
   directions; without them, mutual impacts could repeat without end in finite time (Zeno), as those of the feet of a
   rocking block. Returns whether a velocity pointed into a limit. */
static int impact(const Plant *plant, double y[N_STATES], const int anti_chatter[N_JOINTS])
{
    Contact contact[N_JOINTS];
    double impulse[N_JOINTS], *v = y + N_JOINTS;
    int any = 0;
    find_contacts(plant, y, anti_chatter, contact);
    for (int i = 0; i < N_JOINTS; i++)
        any |= is_pressed(&contact[i], v[i]);
    if (any && plant->value[RIGID_STOPS] != 0.0 && !complementary(plant, y, contact, v, impulse))
        v[0] = NAN; /* which no step accepts */
    else if (plant->value[RIGID_STOPS] == 0.0)
        for (int i = 0; i < N_JOINTS; i++)
            if (is_pressed(&contact[i], v[i]))
                v[i] = 0.0;
    return any;
}

/* Stop the joints that move at y, with the accelerations a, until friction or a rigid stop ends their motion within a
   window, s, which may be 0. Returns whether there are any. */
static int stop_within(const Plant *plant, double window, double y[N_STATES], const double a[N_JOINTS],
                       const int slip[N_JOINTS], const int kept[N_JOINTS])
{
    Contact contact[N_JOINTS];
    double rate[N_JOINTS], free[N_JOINTS], given[N_JOINTS], change[N_JOINTS], impulse[N_JOINTS], *v = y + N_JOINTS;
    int any = 0;
    if (window == 0.0)
        return 0;
    find_contacts(plant, y, kept, contact);
    for (int i = 0; i < N_JOINTS; i++) {
        Contact *own = &contact[i];
        const double friction = window * plant->value[FRICTION + i];
        own->low = own->side < 0.0 ? -HUGE_VAL : friction * (slip[i] - 1); /* beyond the friction in a */
        own->high = own->side > 0.0 ? HUGE_VAL : friction * (slip[i] + 1);
        own->there |= friction > 0.0;
        own->fixed &= v[i] == 0.0 || own->side != 0.0;
        own->side = own->side == 0.0 ? slip[i] : own->side;
        rate[i] = v[i] + window * a[i];
        any |= own->there && rate[i] * v[i] < 0.0;
    }
    if (!any || !complementary(plant, y, contact, rate, impulse))
        return 0;
    for (int i = 0; i < N_JOINTS; i++) {
        free[i] = contact[i].there && rate[i] == 0.0 ? 0.0 : 1.0;
        given[i] = free[i] == 0.0 ? -v[i] : 0.0;
    }
    hybrid_motion(plant, y, &plant->value[ARMATURE], free, given, change, impulse);
    for (int i = 0; i < N_JOINTS; i++)
        v[i] = free[i] == 0.0 ? 0.0 : v[i] + change[i];
    impact(plant, y, kept);
    return 1;
}

/* Add friction to the bounds of joints at rest, which clamps do not have; return whether any joint may rest. */
static int add_friction(const Plant *plant, const double v[N_JOINTS], Contact contact[N_JOINTS])
{
    const int rigid = plant->value[RIGID_STOPS] != 0.0;
    int any = 0;
    for (int i = 0; i < N_JOINTS; i++) {
        Contact *own = &contact[i];
        const int clamps = own->side != 0.0 && !rigid;
        const double friction = clamps && own->fixed && !has_no_range(plant, i) ? 0.0 : plant->value[FRICTION + i];
        any |= v[i] == 0.0 && (friction > 0.0 || own->there); /* other joints move away */
        own->there = v[i] == 0.0 && (friction > 0.0 || (own->there && rigid));
        own->fixed &= !clamps;
        own->low = (clamps ? 0.0 : own->low) - friction;
        own->high = (clamps ? 0.0 : own->high) + friction;
    }
    return any;
}

/* Add to a the accelerations that the friction of joints that begin to slip causes. */
static void add_slip(const Plant *plant, const double y[N_STATES], const Stops *stops, double a[N_JOINTS])
{
    double free[N_JOINTS], given[N_JOINTS], change[N_JOINTS], none[N_JOINTS];
    int any = 0;
    for (int i = 0; i < N_JOINTS; i++) {
        free[i] = 1.0;
        given[i] = y[N_JOINTS + i] == 0.0 ? -plant->value[FRICTION + i] * stops->slip[i] : 0.0;
        any |= given[i] != 0.0;
    }
    if (any)
        hybrid_motion(plant, y, &plant->value[ARMATURE], free, given, change, none);
    for (int i = 0; any && i < N_JOINTS; i++)
        a[i] += change[i];
}

/* Find the regime at y after an impact, with the given rank of J⁺. a receives q̈ in this regime, effort the result of
   restrain, margin that of acceleration. Resting joints in kept stay at rest even if the holding effort exceeds its
   bounds. Joints whose motion friction or a rigid stop ends within a window, s, stop at once: the window is that of an
   impact, and otherwise 0. */
INTERNAL void find_regime(const Plant *plant, double y[N_STATES], const int kept[N_JOINTS], int rank, double window,
                          Stops *stops, double a[N_JOINTS], double effort[N_JOINTS], double *margin)
{
    const int rigid = plant->value[RIGID_STOPS] != 0.0;
    const double *v = y + N_JOINTS;
    Contact contact[N_JOINTS];
    double stopped[N_JOINTS];
    memset(stops, 0, sizeof *stops);
    for (int i = 0; i < N_JOINTS; i++) {
        stops->slip[i] = plant->value[FRICTION + i] > 0.0 ? (v[i] > 0.0) - (v[i] < 0.0) : 0;
        stops->any_slip |= stops->slip[i] != 0;
    }
    stops->rank = acceleration(plant, y, v, slip_of(stops), rank, a, margin);
    if (stop_within(plant, window, y, a, stops->slip, kept)) {
        find_regime(plant, y, kept, rank, 0.0, stops, a, effort, margin);
        return;
    }
    find_contacts(plant, y, kept, contact);
    if (!add_friction(plant, v, contact))
        return;
    memcpy(stopped, a, sizeof stopped);
    if (!complementary(plant, y, contact, stopped, effort)) {
        for (int i = 0; i < N_JOINTS; i++)
            a[i] = NAN; /* which no step accepts */
        return;
    }
    for (int i = 0; i < N_JOINTS; i++) {
        const Contact *own = &contact[i];
        const int rests = own->there && stopped[i] == 0.0;
        const int clamps = !rigid && own->side != 0.0 && v[i] == 0.0 && !rests;
        if (clamps && (kept[i] || has_no_range(plant, i) || own->side * stopped[i] <= 0.0))
            stops->held[i] = CLAMPED;
        else if (rests)
            stops->held[i] = own->side != 0.0 && rigid ? STOPPED : STUCK;
        if (own->there && !rests && plant->value[FRICTION + i] > 0.0)
            stops->slip[i] = -own->at;
        stops->any_slip |= stops->slip[i] != 0;
        const int acts_alike = rigid || (stops->held[i] == CLAMPED && !stops->slip[i]); /* whatever the efforts are */
        stops->watched[i] = stops->held[i] && !kept[i] && !(has_no_range(plant, i) && acts_alike);
        stops->any_held |= stops->held[i] != FREE;
        stops->any_watched |= stops->watched[i];
    }
    if (rigid) { /* no clamps: the problem's solution has all */
        memcpy(a, stopped, sizeof stopped);
        return;
    }
    add_slip(plant, y, stops, a);
    restrain(plant, stops, y, a, effort);
}

/* Distance of a joint's holding effort from its lower (side −1) or upper (side 1) bound; HUGE_VAL without a bound. A
   watched joint is released if one is negative. */
INTERNAL double grip(const Plant *plant, const Stops *stops, int i, double q, double effort, int side)
{
    const double friction = stops->held[i] == CLAMPED ? 0.0 : plant->value[FRICTION + i];
    const int pressed = has_no_range(plant, i) ? stops->slip[i] : is_above(plant, q, i) ? 1 : -1;
    if (stops->held[i] != STUCK && side != pressed)
        return HUGE_VAL;
    return friction - side * effort;
}

/* Bound on the rounding error of the holding efforts. */
INTERNAL double rounding_of(const Stops *stops, const double effort[N_JOINTS])
{
    double largest = 0.0;
    for (int i = 0; i < N_JOINTS; i++)
        largest = fmax(largest, stops->held[i] ? fabs(effort[i]) : 0.0);
    return 2.0 * ROUNDING_OF_SUM * largest;
}
#endif

/* Compute the derivatives of the plant's state, with joints at rest held. */
INTERNAL void compute_rates(Plant *plant, const Stops *stops)
{
    double *value = plant->value, effort[N_JOINTS];
    memcpy(&value[DER_Q], &value[V], N_JOINTS * sizeof *value);
    acceleration(plant, &value[Q], &value[V], slip_of(stops), stops->rank, &value[DER_V], NULL);
    restrain(plant, stops, &value[Q], &value[DER_V], effort);
}
