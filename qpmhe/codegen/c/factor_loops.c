/* Blocks of the Gauss-Newton QP by loops. */

static int mhe_dense_terms(const real *Q, const real *w, mhe_terms *t)
{
    (void)Q; (void)w; (void)t;
    return 0;
}

#if !defined(MHE_VECTORS)
/* Columns of a panel that are updated at once: as many as fit in a processor's registers, and
 * a fixed number, so that a compiler can keep them there. */
#define CHUNK (WIDTH <= 48 ? WIDTH : 32)

/* Overwrite a panel by the rows of D L'; whether its pivots are positive. */
static int mhe_eliminate(real *panel, real *inverse)
{
    for (int r = 0; r < NX; r++) {
        real *row = panel + r * WIDTH;
        for (int b = r / CHUNK * CHUNK; b < WIDTH; b += CHUNK) {
            real sums[CHUNK];
            for (int c = 0; c < CHUNK; c++) sums[c] = row[b + c];
            for (int j = 0; j < r; j++) {
                const real *above = panel + j * WIDTH + b, factor = panel[j * WIDTH + r] * inverse[j];
                for (int c = 0; c < CHUNK; c++) sums[c] -= factor * above[c];
            }
            for (int c = 0; c < CHUNK; c++) row[b + c] = sums[c];
        }
        const real pivot = row[r];
        if (!(pivot > 0) || !isfinite(pivot)) return 0;
        inverse[r] = 1 / pivot;
    }
    return 1;
}

/* Subtract C' D^-1 C from the upper half of the next block, for the coupling C of a panel. */
static void mhe_subtract(const real *panel, const real *inverse, real *next)
{
    for (int r = 0; r < NX; r++) {
        real sums[NX];
        for (int c = 0; c < NX; c++) sums[c] = 0;
        for (int j = 0; j < NX; j++) {
            const real *row = panel + j * WIDTH + NX, factor = row[r] * inverse[j];
            for (int c = 0; c < NX; c++) sums[c] += factor * row[c];
        }
        for (int c = 0; c < NX; c++) next[r * WIDTH + c] -= sums[c];
    }
}
#endif

/* Overwrite the panels by the rows of D L', with H = L D L'; whether H was positive definite.
 * No square roots: their latency would be half of the time at small sizes. */
static int mhe_factorise(mhe_workspace *k, int count)
{
    for (int i = 0; i <= count; i++) {
        real *panel = k->panels + i * NX * WIDTH, *inverse = k->inverse_pivots + i * NX;
        if (!mhe_eliminate(panel, inverse)) return 0;
        if (i < count) mhe_subtract(panel, inverse, panel + NX * WIDTH);
    }
    return 1;
}
