/* Normal random numbers as a function of seed, sample and channel, bit-identical to those of plant/noise.py:
   Philox4x32-10 and the polar method, with basic operations of IEEE 754 only.

   Sources: Salmon, Moraes, Dror & Shaw, SC 2011; Marsaglia & Bray, SIAM Review 6(3), 1964. */
#include <math.h>
#include <stdint.h>

enum { ROUNDS = 10, TERMS = 11 };
static const double LN2 = 0.6931471805599453, SQRT_HALF = 0.7071067811865476;

static void philox(uint32_t word[4], uint32_t k, uint32_t m)
{
    for (int round = 0; round < ROUNDS; round++) {
        const uint64_t first = UINT64_C(0xD2511F53) * word[0], second = UINT64_C(0xCD9E8D57) * word[2];
        word[0] = (uint32_t)(second >> 32) ^ word[1] ^ k;
        word[1] = (uint32_t)second;
        word[2] = (uint32_t)(first >> 32) ^ word[3] ^ m;
        word[3] = (uint32_t)first;
        k += UINT32_C(0x9E3779B9);
        m += UINT32_C(0xBB67AE85);
    }
}

/* A product that no compiler fuses with a sum, with any flags. */
static double product(double a, double b)
{
    volatile double rounded = a * b;
    return rounded;
}

/* ln x of a normal number > 0, within four units in the last place. */
static double logarithm(double x)
{
    int exponent;
    double m = frexp(x, &exponent), series = 0.0;
    if (m < SQRT_HALF) {
        m *= 2.0;
        exponent--;
    }
    const double z = (m - 1.0) / (m + 1.0), square = product(z, z); /* ln m = 2 artanh z */
    for (int k = TERMS - 1; k >= 0; k--)
        series = product(series, square) + 1.0 / (2 * k + 1);
    return product(exponent, LN2) + product(2.0 * z, series);
}

/* In [−1, 1), of 53 bits. */
static double uniform(uint32_t high, uint32_t low)
{
    return (double)(((uint64_t)high << 32 | low) >> 11) / 4503599627370496.0 - 1.0;
}

/* Two independent standard normal numbers for a seed, a sample k < 2⁵³ and a channel. */
static void normal_pair(double seed, double k, int channel, double pair[2])
{
    const uint64_t sample = (uint64_t)k;
    for (uint32_t attempt = 0;; attempt++) {
        uint32_t word[4] = {(uint32_t)sample, (uint32_t)(sample >> 32), (uint32_t)channel, attempt};
        philox(word, (uint32_t)seed, 0);
        const double u = uniform(word[0], word[1]), w = uniform(word[2], word[3]);
        const double s = product(u, u) + product(w, w);
        if (s > 0.0 && s < 1.0) {
            const double factor = sqrt(product(-2.0, logarithm(s)) / s);
            pair[0] = product(u, factor);
            pair[1] = product(w, factor);
            return;
        }
    }
}
