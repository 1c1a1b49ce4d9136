"""Normal random numbers as a function of seed, sample and channel, bit-identical on every platform.

Philox4x32-10 gives the uniform numbers. It is a function of a counter and a key, so that noise has no state. The polar
method makes them normal: u √(−2 ln s / s) with s = u² + w² < 1. Its logarithm uses basic operations of IEEE 754 only.

Sources: Salmon, Moraes, Dror & Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011; Marsaglia & Bray, "A
convenient method for generating normal variables", SIAM Review 6(3), 1964.
"""

from math import frexp, sqrt

ROUNDS = 10
WORD = 2**32 - 1
LN2 = 0.6931471805599453
SQRT_HALF = 0.7071067811865476
TERMS = 11  # terms of the logarithm's series; the rest is below rounding


def philox(counter: tuple[int, int, int, int], key: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return four random 32-bit words by Philox4x32-10."""
    a, b, c, d = counter
    k, m = key
    for _ in range(ROUNDS):
        first, second = 0xD2511F53 * a, 0xCD9E8D57 * c
        a, b, c, d = second >> 32 ^ b ^ k, second & WORD, first >> 32 ^ d ^ m, first & WORD
        k, m = k + 0x9E3779B9 & WORD, m + 0xBB67AE85 & WORD
    return a, b, c, d


def logarithm(x: float) -> float:
    """Return ln x of a normal number > 0, within four units in the last place."""
    m, exponent = frexp(x)
    if m < SQRT_HALF:
        m, exponent = 2.0 * m, exponent - 1
    z = (m - 1.0) / (m + 1.0)  # ln m = 2 artanh z
    square, series = z * z, 0.0
    for k in reversed(range(TERMS)):
        series = series * square + 1.0 / (2 * k + 1)
    return exponent * LN2 + 2.0 * z * series


def normal_pair(seed: int, k: int, channel: int) -> tuple[float, float]:
    """Return two independent standard normal numbers for a seed, a sample k < 2⁵³ and a channel."""
    attempt = 0
    while True:
        a, b, c, d = philox((k & WORD, k >> 32, channel, attempt), (seed, 0))
        u, w = (float((high << 32 | low) >> 11) * 2.0**-52 - 1.0 for high, low in ((a, b), (c, d)))
        s = u * u + w * w
        if 0.0 < s < 1.0:
            factor = sqrt(-2.0 * logarithm(s) / s)
            return u * factor, w * factor
        attempt += 1
