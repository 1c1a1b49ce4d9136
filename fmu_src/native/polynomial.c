/* Values and sign changes of polynomials. */

static const double ROOT_RESOLUTION = 1.0 / 4503599627370496.0; /* 2⁻⁵² */

/* The value of a polynomial; its coefficients begin with the constant. */
static double polynomial(const double c[], int degree, double x)
{
    double sum = c[degree];
    for (int k = degree - 1; k >= 0; k--)
        sum = sum * x + c[k];
    return sum;
}

/* Find the points in (0, 1) at which a polynomial of degree 4 or less changes its sign, in ascending order; return
   their number. The polynomial is monotonic between the sign changes of its derivative. */
static int sign_changes(const double c[], int degree, double root[])
{
    double slope[4], turn[5], left = 0.0;
    int turns = 0, count = 0;
    if (degree == 0)
        return 0;
    for (int k = 1; k <= degree; k++)
        slope[k - 1] = k * c[k];
    turns = sign_changes(slope, degree - 1, turn);
    turn[turns] = 1.0;
    for (int k = 0; k <= turns; left = turn[k++]) {
        const double before = polynomial(c, degree, left);
        if (!(before * polynomial(c, degree, turn[k]) < 0.0))
            continue;
        double low = left, high = turn[k];
        while (high - low > ROOT_RESOLUTION) {
            const double middle = 0.5 * (low + high);
            if (polynomial(c, degree, middle) * before > 0.0)
                low = middle;
            else
                high = middle;
        }
        root[count++] = high;
    }
    return count;
}
