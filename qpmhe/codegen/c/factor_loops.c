/* Blocks of the Gauss-Newton QP by loops. */

static int mhe_dense_terms(const real *Q, const real *w, mhe_terms *t)
{
    (void)Q; (void)w; (void)t;
    return 0;
}

/* Two rows at a time share what they read of the rows above. These are the columns of both that are
 * updated at once, while they are factorised and in the next block: as many as fit in a processor's
 * registers, and fixed numbers, so that a compiler can keep them there. Which are the quickest, only
 * trying tells: GCC 12 on x86-64, at -O3 and -O2. ROW_COLUMNS divides the width of a panel. */
#define ROW_COLUMNS (NX >= 24 ? 16 : NX > 4 && WIDTH % 8 == 0 ? 8 : WIDTH % 12 == 0 ? 12 : 4)
#define TILE_COLUMNS (NX > 24 ? NX : NX > 20 || WIDTH == 36 ? 24 : WIDTH == 12 ? 8 : 4)

/* Note a pivot's inverse; whether it is positive. */
static int mhe_take_pivot(real pivot, real *inverse)
{
    if (!(pivot > 0) || !isfinite(pivot)) return 0;
    *inverse = 1 / pivot;
    return 1;
}

/* Overwrite the panels by the rows of D L', with H = L D L'; whether H was positive definite.
 * No square roots: their latency would be half of the time at small sizes. Factors are not computed
 * ahead: the code that GCC 12 made of that took up to 12 times as long. */
static int mhe_factorise(mhe_workspace *k, int count)
{
    for (int i = 0; i <= count; i++) {
        real *restrict panel = k->panels + i * NX * WIDTH;
        real *restrict inverse = k->inverse_pivots + i * NX;
        for (int r = 0; r < NX; r += 2) {
            const int other = r + 1 < NX; /* 0 where there is no second row */
            real *row = panel + r * WIDTH, *below = row + other * WIDTH;
            for (int b = r / ROW_COLUMNS * ROW_COLUMNS; b < WIDTH; b += ROW_COLUMNS) {
                real sums[ROW_COLUMNS], more[ROW_COLUMNS];
                for (int c = 0; c < ROW_COLUMNS; c++) sums[c] = row[b + c];
                for (int c = 0; c < ROW_COLUMNS; c++) more[c] = below[b + c];
                for (int j = 0; j < r; j++) {
                    const real *above = panel + j * WIDTH;
                    const real f = above[r] * inverse[j], g = above[r + other] * inverse[j];
                    for (int c = 0; c < ROW_COLUMNS; c++) {
                        sums[c] -= f * above[b + c];
                        more[c] -= g * above[b + c];
                    }
                }
                for (int c = 0; c < ROW_COLUMNS; c++) row[b + c] = sums[c];
                if (other)
                    for (int c = 0; c < ROW_COLUMNS; c++) below[b + c] = more[c];
            }
            if (!mhe_take_pivot(row[r], inverse + r)) return 0;
            if (!other) break;
            const real f = row[r + 1] * inverse[r];
            for (int c = (r + 1) & ~3; c < WIDTH; c++) below[c] -= f * row[c];
            if (!mhe_take_pivot(below[r + 1], inverse + r + 1)) return 0;
        }
        if (i == count) break;
        /* The upper half; a tile may read beyond a row's end, but does not write there. */
        real *next = panel + NX * WIDTH;
        for (int r = 0; r < NX; r += 2) {
            const int other = r + 1 < NX;
            for (int b = r / TILE_COLUMNS * TILE_COLUMNS; b < NX; b += TILE_COLUMNS) {
                real sums[TILE_COLUMNS], more[TILE_COLUMNS];
                for (int c = 0; c < TILE_COLUMNS; c++) sums[c] = more[c] = 0;
                for (int j = 0; j < NX; j++) {
                    const real *row = panel + j * WIDTH + NX;
                    const real f = row[r] * inverse[j], g = row[r + other] * inverse[j];
                    for (int c = 0; c < TILE_COLUMNS; c++) {
                        sums[c] += f * row[b + c];
                        more[c] += g * row[b + c];
                    }
                }
                const int width = NX - b < TILE_COLUMNS ? NX - b : TILE_COLUMNS;
                real *to = next + r * WIDTH + b;
                for (int c = 0; c < width; c++) to[c] -= sums[c];
                if (other)
                    for (int c = 0; c < width; c++) to[WIDTH + c] -= more[c];
            }
        }
    }
    return 1;
}
