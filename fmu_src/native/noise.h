/* Random numbers of a counter, the same on every platform. */
#ifndef NOISE_H
#define NOISE_H

#include "internal.h"

/* Two independent standard normal numbers of a seed, a sample k < 2⁵³ and a channel. */
INTERNAL void normal_pair(double seed, double k, int channel, double pair[2]);

#endif
