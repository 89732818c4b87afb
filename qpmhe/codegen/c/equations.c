/* Equations by Newton's method: its end, and LU factors with row pivots. */

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

/* The largest share that a correction has of some sizes: infinity where one leads to 0. */
static real mhe_share(int size, const real *step, const real *sizes)
{
    real length = 0;
    for (int i = 0; i < size; i++) {
        const real share = step[i] != 0 ? (real)fabs(step[i]) / sizes[i] : 0;
        if (isnan(share)) return NAN;
        length = mhe_max(share, length);
    }
    return length;
}

/* Turn sizes of equations into reciprocals. One without a size, of infinity, contains only unknowns
 * without one, and is solved for these. */
static void mhe_reciprocals(int size, real *sizes)
{
    for (int i = 0; i < size; i++) sizes[i] = sizes[i] > 0 ? 1 / sizes[i] : INFINITY;
}

static void mhe_exchange(real *a, real *b)
{
    const real held = *a;
    *a = *b;
    *b = held;
}

/* The factors of M, stored by columns, in place, with the reciprocals of pivots; whether M is
 * regular. Pivots are compared as shares of the equations' sizes, of which `per` has the reciprocals,
 * so that units do not matter. */
static int mhe_factor_equations(int size, real *M, real *per, int *pivot)
{
    for (int c = 0; c < size; c++) {
        real *column = M + c * size, most = 0;
        int best = c;
        for (int r = c; r < size; r++) {
            const real share = (real)fabs(column[r]) * per[r];
            /* Equations without a size are compared by their numbers. */
            if (share > most || (isinf(share) && fabs(column[r]) > fabs(column[best]))) {
                most = share;
                best = r;
            }
        }
        pivot[c] = best;
        if (!(fabs(column[best]) > 0) || !isfinite(column[best])) return 0;
        if (best != c) {
            mhe_exchange(per + c, per + best);
            for (int j = 0; j < size; j++) mhe_exchange(M + j * size + c, M + j * size + best);
        }
        const real share = 1 / column[c];
        column[c] = share;
        for (int r = c + 1; r < size; r++) column[r] *= share;
        for (int j = c + 1; j < size; j++) {
            real *other = M + j * size;
            const real factor = other[c];
            if (factor != 0)
                for (int r = c + 1; r < size; r++) other[r] -= factor * column[r];
        }
    }
    for (int c = size - 1; c >= 0; c--) mhe_exchange(per + c, per + pivot[c]);
    return 1;
}

/* The solution of M z = z, with the factors of M, in place. */
static void mhe_solve_equations(int size, const real *M, const int *pivot, real *z)
{
    for (int c = 0; c < size; c++) mhe_exchange(z + c, z + pivot[c]);
    for (int c = 0; c < size; c++)
        for (int r = c + 1; r < size; r++) z[r] -= z[c] * M[c * size + r];
    for (int c = size - 1; c >= 0; c--) {
        const real found = z[c] *= M[c * size + c];
        for (int r = 0; r < c; r++) z[r] -= found * M[c * size + r];
    }
}

/* The same for some columns z, stored by rows. */
static void mhe_solve_columns(int size, const real *M, const int *pivot, int columns, real *z)
{
    for (int c = 0; c < size; c++) {
        real *row = z + c * columns, *other = z + pivot[c] * columns;
        if (pivot[c] == c) continue;
        for (int j = 0; j < columns; j++) mhe_exchange(row + j, other + j);
    }
    for (int c = 0; c < size; c++) {
        const real *row = z + c * columns;
        for (int r = c + 1; r < size; r++) {
            const real share = M[c * size + r];
            if (share != 0)
                for (int j = 0; j < columns; j++) z[r * columns + j] -= share * row[j];
        }
    }
    for (int c = size - 1; c >= 0; c--) {
        real *row = z + c * columns;
        for (int j = 0; j < columns; j++) row[j] *= M[c * size + c];
        for (int r = 0; r < c; r++) {
            const real share = M[c * size + r];
            if (share != 0)
                for (int j = 0; j < columns; j++) z[r * columns + j] -= share * row[j];
        }
    }
}
