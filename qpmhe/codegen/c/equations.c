/* Equations by Newton's method: its end, and LU factors with row pivots. Matrices are stored by
 * rows. */

/* Whether rounding stops Newton's method behind corrections of these shares, or it converges so
 * fast that the next correction would be rounding. */
static int mhe_converged(real length, real last)
{
    const real rate = length / last;
    return length <= (real)$rounding ||
           (length <= (real)$small &&
            (length > last / 2 || (isfinite(last) && length * rate * rate <= (real)$rounding)));
}

/* Whether equations are nearly linear along a step of this factor: how far the correction behind it
 * is from that of linear ones, as a share of the whole step. The last steps need a finite value. */
static int mhe_straight(real curved, real factor, real before, real length)
{
    return curved <= (real)$curved * factor * before || (length <= (real)$small && isfinite(curved));
}

/* The factor at which equations of second order would be nearly linear, within bounds. */
static real mhe_shorter(real curved, real factor, real before)
{
    const real predicted = (real)$curved * factor * before / curved;
    return factor * (predicted < (real)$most ? mhe_max(predicted, $least) : (real)$most);
}

/* The largest share that a correction has of some sizes. */
static real mhe_share(int size, const real *step, const real *sizes)
{
    real length = 0;
    for (int i = 0; i < size; i++) {
        const real share = step[i] != 0 ? (real)fabs(step[i]) / sizes[i] : 0;
        if (!isfinite(share)) return NAN;
        length = mhe_max(share, length);
    }
    return length;
}

/* The factors of M, in place; whether M is regular. */
static int mhe_factor_equations(int size, real *M, int *pivot)
{
    for (int c = 0; c < size; c++) {
        int best = c;
        for (int r = c + 1; r < size; r++)
            if (fabs(M[r * size + c]) > fabs(M[best * size + c])) best = r;
        pivot[c] = best;
        if (!(fabs(M[best * size + c]) > 0) || !isfinite(M[best * size + c])) return 0;
        if (best != c)
            for (int j = 0; j < size; j++) {
                const real held = M[c * size + j];
                M[c * size + j] = M[best * size + j];
                M[best * size + j] = held;
            }
        for (int r = c + 1; r < size; r++) {
            const real share = M[r * size + c] /= M[c * size + c];
            if (share != 0)
                for (int j = c + 1; j < size; j++) M[r * size + j] -= share * M[c * size + j];
        }
    }
    return 1;
}

/* The solution of M z = z of some columns, with the factors of M, in place. */
static void mhe_solve_equations(int size, const real *M, const int *pivot, int columns, real *z)
{
    for (int c = 0; c < size; c++)
        if (pivot[c] != c)
            for (int j = 0; j < columns; j++) {
                const real held = z[c * columns + j];
                z[c * columns + j] = z[pivot[c] * columns + j];
                z[pivot[c] * columns + j] = held;
            }
    for (int c = 0; c < size; c++)
        for (int r = c + 1; r < size; r++)
            for (int j = 0; j < columns; j++)
                z[r * columns + j] -= M[r * size + c] * z[c * columns + j];
    for (int c = size - 1; c >= 0; c--) {
        for (int j = 0; j < columns; j++) z[c * columns + j] /= M[c * size + c];
        for (int r = 0; r < c; r++)
            for (int j = 0; j < columns; j++)
                z[r * columns + j] -= M[r * size + c] * z[c * columns + j];
    }
}
