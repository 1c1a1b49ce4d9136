/* Joint-limit stops and friction by the equations of plant/stops.py. A stop without reaction is a clamp: a joint rests
   while its own acceleration points into the limit. A rigid stop acts on all joints, as friction does.

   Source: Featherstone, "Rigid Body Dynamics Algorithms", 2008, sections 11.1 to 11.5; Pfeiffer & Glocker,
   "Multibody Dynamics with Unilateral Contacts", 1996, chapter 5. */
#include "stops.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

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
/* Factor of the times within which events at rigid stops count as one: below 1 if rtol is below its default. */
INTERNAL double coarseness(const Plant *plant)
{
    return fmin(1.0, plant->value[RTOL] / USUAL_RTOL);
}

/* The tolerance of the error test on a position. */
INTERNAL double tolerance_of(const Plant *plant, double q)
{
    return plant->value[ATOL] + plant->value[RTOL] * fabs(q);
}

/* Remove the velocity that points into a limit from the state y = (q, v). Joints in anti_chatter stop in both
   directions; without them, mutual impacts could repeat without end in finite time (Zeno), as those of the feet of a
   rocking block. Returns whether a velocity pointed into a limit. */
INTERNAL int impact(const Plant *plant, double y[N_STATES], const int anti_chatter[N_JOINTS])
{
    Contact contact[N_JOINTS];
    double impulse[N_JOINTS], *v = y + N_JOINTS;
    int any = 0;
    find_contacts(plant, y, anti_chatter, contact);
    for (int i = 0; i < N_JOINTS; i++)
        any |= is_pressed(&contact[i], v[i]);
    if (any && plant->value[RIGID_STOPS] != 0.0 && !complementary(plant, y, contact, 0.0, v, impulse))
        v[0] = NAN; /* which no step accepts */
    else if (plant->value[RIGID_STOPS] == 0.0)
        for (int i = 0; i < N_JOINTS; i++)
            if (is_pressed(&contact[i], v[i]))
                v[i] = 0.0;
    return any;
}

/* Stop the joints that move at y, with the accelerations a, until friction or a rigid stop ends their motion within a
   window, s, which may be 0, and within the tolerance of their positions. Returns whether there are any. */
static int stop_within(const Plant *plant, double window, double y[N_STATES], const double a[N_JOINTS],
                       const int slip[N_JOINTS], const int on_hold[N_JOINTS])
{
    Contact contact[N_JOINTS];
    double rate[N_JOINTS], impulse[N_JOINTS], *v = y + N_JOINTS;
    int rests[N_JOINTS], any = 0, stops = 0;
    if (window == 0.0)
        return 0;
    find_contacts(plant, y, on_hold, contact);
    for (int i = 0; i < N_JOINTS; i++) {
        Contact *own = &contact[i];
        const double friction = window * plant->value[FRICTION + i];
        own->low = own->side < 0.0 ? -HUGE_VAL : friction * (slip[i] - 1); /* beyond the friction in a */
        own->high = own->side > 0.0 ? HUGE_VAL : friction * (slip[i] + 1);
        own->there = (own->there || friction > 0.0) && 0.5 * window * fabs(v[i]) <= tolerance_of(plant, y[i]);
        own->fixed &= v[i] == 0.0 || own->side != 0.0;
        own->side = own->side == 0.0 ? slip[i] : own->side;
        rate[i] = v[i] + window * a[i];
        any |= own->there && rate[i] * v[i] < 0.0;
    }
    if (!any || !complementary(plant, y, contact, window * acting_effort(plant, y, v, a), rate, impulse))
        return 0;
    for (int i = 0; i < N_JOINTS; i++) {
        rests[i] = contact[i].there && rate[i] == 0.0;
        stops |= rests[i] && v[i] != 0.0;
    }
    if (!stops)
        return 0;
    find_contacts(plant, y, on_hold, contact); /* of impacts that follow, in which these joints rest */
    for (int i = 0; i < N_JOINTS; i++) {
        contact[i].there |= rests[i];
        contact[i].fixed |= rests[i];
    }
    if (!complementary(plant, y, contact, 0.0, v, impulse))
        v[0] = NAN; /* which no step accepts */
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
   restrain, margin that of acceleration. Resting joints in on_hold stay at rest even if the holding effort exceeds its
   bounds. Joints whose motion friction or a rigid stop ends within a window, s, stop at once: the window is that of an
   impact, and otherwise 0. */
INTERNAL void find_regime(const Plant *plant, double y[N_STATES], const int on_hold[N_JOINTS], int rank, double window,
                          Stops *stops, double a[N_JOINTS], double effort[N_JOINTS], double *margin)
{
    const int rigid = plant->value[RIGID_STOPS] != 0.0;
    const double *v = y + N_JOINTS;
    Contact contact[N_JOINTS];
    double stopped[N_JOINTS];
    int any = 0;
    memset(stops, 0, sizeof *stops);
    for (int i = 0; i < N_JOINTS; i++) {
        stops->slip[i] = plant->value[FRICTION + i] > 0.0 ? (v[i] > 0.0) - (v[i] < 0.0) : 0;
        stops->any_slip |= stops->slip[i] != 0;
    }
    stops->rank = acceleration(plant, y, v, slip_of(stops), rank, a, margin);
    if (stop_within(plant, window, y, a, stops->slip, on_hold)) {
        find_regime(plant, y, on_hold, rank, 0.0, stops, a, effort, margin);
        return;
    }
    find_contacts(plant, y, on_hold, contact);
    if (!add_friction(plant, v, contact))
        return;
    for (int i = 0; i < N_JOINTS; i++)
        any |= contact[i].there;
    const double acting = any ? acting_effort(plant, y, v, a) : 0.0;
    memcpy(stopped, a, sizeof stopped);
    if (!complementary(plant, y, contact, acting, stopped, effort)) {
        for (int i = 0; i < N_JOINTS; i++)
            a[i] = NAN; /* which no step accepts */
        return;
    }
    stops->acting = acting;
    for (int i = 0; i < N_JOINTS; i++) {
        const Contact *own = &contact[i];
        const int rests = own->there && stopped[i] == 0.0;
        const int clamps = !rigid && own->side != 0.0 && v[i] == 0.0 && !rests;
        if (clamps && (on_hold[i] || has_no_range(plant, i) || own->side * stopped[i] <= 0.0))
            stops->held[i] = CLAMPED;
        else if (rests)
            stops->held[i] = own->side != 0.0 && rigid ? STOPPED : STUCK;
        if (own->there && !rests && plant->value[FRICTION + i] > 0.0) {
            stops->slip[i] = -own->at;
            stops->acting = fmax(stops->acting, plant->value[FRICTION + i]);
        }
        stops->any_slip |= stops->slip[i] != 0;
        const int acts_alike = rigid || (stops->held[i] == CLAMPED && !stops->slip[i]); /* whatever the efforts are */
        stops->watched[i] = stops->held[i] && !on_hold[i] && !(has_no_range(plant, i) && acts_alike);
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

/* Bound on the rounding error of the holding efforts, which may be small differences of the efforts that act. */
INTERNAL double rounding_of(const Stops *stops, const double effort[N_JOINTS])
{
    double largest = stops->acting;
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
