/* Panels in tiles of four rows and up to twelve columns, which fit in the registers of a processor
 * that computes with four numbers at once: its rows share what they read of those above. */
#if defined(__GNUC__) && defined(__AVX2__)
#define MHE_VECTORS
#define LANES 4
#define TILE 3 /* most vectors in a row of a tile */
/* Loops over rows and vectors must end at constants, so that compilers unroll them. */
#define INLINE static inline __attribute__((always_inline))
typedef real mhe_lanes
    __attribute__((vector_size(LANES * sizeof(real)), aligned(sizeof(real)), may_alias));

INLINE const mhe_lanes *mhe_lanes_of(const real *a) { return (const mhe_lanes *)a; }

/* sums -= F' A, for the first rows of F', and A of `count` rows. */
INLINE void mhe_reduce_tile(int rows, int tile, int count, const real *factors, const real *above,
                            mhe_lanes sums[LANES][TILE])
{
    for (int j = 0; j < count; j++, factors += LANES, above += WIDTH) {
        mhe_lanes x[TILE];
        for (int c = 0; c < tile; c++) x[c] = mhe_lanes_of(above)[c];
        for (int q = 0; q < rows; q++)
            for (int c = 0; c < tile; c++) sums[q][c] -= factors[q] * x[c];
    }
}

/* A tile of row r and those behind; `own` is what its rows have of each other, from the first. */
INLINE int mhe_eliminate_tile(int rows, int tile, int first, int r, int b, const real *factors,
                              real own[LANES][LANES], real *panel, real *inverse)
{
    mhe_lanes sums[LANES][TILE];
    real *to = panel + r * WIDTH + b;
    for (int q = 0; q < rows; q++)
        for (int c = 0; c < tile; c++) sums[q][c] = mhe_lanes_of(to + q * WIDTH)[c];
    mhe_reduce_tile(rows, tile, r, factors, panel + b, sums);
    for (int p = 0; p < rows; p++) {
        if (first) {
            const mhe_lanes row = sums[p][0];
            if (!(row[p] > 0) || !isfinite(row[p])) return 0;
            inverse[r + p] = 1 / row[p];
            for (int q = p + 1; q < rows; q++) own[p][q] = row[q] * inverse[r + p];
        }
        for (int q = p + 1; q < rows; q++)
            for (int c = 0; c < tile; c++) sums[q][c] -= own[p][q] * sums[p][c];
    }
    for (int q = 0; q < rows; q++)
        for (int c = 0; c < tile; c++) ((mhe_lanes *)(to + q * WIDTH))[c] = sums[q][c];
    return 1;
}

/* As many vectors as there are up to the end. */
INLINE int mhe_eliminate_some(int rows, int first, int r, int b, const real *factors,
                              real own[LANES][LANES], real *panel, real *inverse)
{
    const int left = (2 * NX + LANES - 1) / LANES - b / LANES;
    if (left >= 3) return mhe_eliminate_tile(rows, 3, first, r, b, factors, own, panel, inverse);
    if (left == 2) return mhe_eliminate_tile(rows, 2, first, r, b, factors, own, panel, inverse);
    return left < 1 || mhe_eliminate_tile(rows, 1, first, r, b, factors, own, panel, inverse);
}

INLINE int mhe_eliminate_rows(int rows, int r, real *panel, real *inverse)
{
    real factors[NX * LANES], own[LANES][LANES];
    for (int j = 0; j < r; j++)
        ((mhe_lanes *)factors)[j] = *mhe_lanes_of(panel + j * WIDTH + r) * inverse[j];
    if (!mhe_eliminate_some(rows, 1, r, r, factors, own, panel, inverse)) return 0;
    for (int b = r + TILE * LANES; b < 2 * NX; b += TILE * LANES)
        mhe_eliminate_some(rows, 0, r, b, factors, own, panel, inverse);
    return 1;
}

/* Overwrite a panel by the rows of D L'; whether its pivots are positive. */
static int mhe_eliminate(real *panel, real *inverse)
{
    int r = 0;
    for (; r + LANES <= NX; r += LANES)
        if (!mhe_eliminate_rows(LANES, r, panel, inverse)) return 0;
    return NX % LANES == 0 || mhe_eliminate_rows(NX % LANES, r, panel, inverse);
}

/* A tile of the next block; a tile may read beyond a row's end, but does not write there. */
INLINE void mhe_subtract_tile(int rows, int tile, int whole, const real *factors,
                              const real *above, real *to)
{
    mhe_lanes sums[LANES][TILE];
    for (int q = 0; q < rows; q++)
        for (int c = 0; c < tile; c++) sums[q][c] = (mhe_lanes){0};
    mhe_reduce_tile(rows, tile, NX, factors, above, sums);
    for (int q = 0; q < rows; q++)
        for (int c = 0; c < tile; c++) {
            real *at = to + q * WIDTH + c * LANES;
            if (whole || c < tile - 1) *(mhe_lanes *)at += sums[q][c];
            else for (int l = 0; l < NX % LANES; l++) at[l] += sums[q][c][l];
        }
}

INLINE void mhe_subtract_rows(int rows, int r, const real *panel, const real *inverse,
                              real *next)
{
    const int whole = NX % LANES == 0;
    real factors[NX * LANES];
    const real *above = panel + NX + r;
    real *to = next + r * WIDTH + r;
    for (int j = 0; j < NX; j++)
        ((mhe_lanes *)factors)[j] = *mhe_lanes_of(above + j * WIDTH) * inverse[j];
    int left = NX - r;
    for (; left >= TILE * LANES; left -= TILE * LANES, above += TILE * LANES, to += TILE * LANES)
        mhe_subtract_tile(rows, TILE, 1, factors, above, to);
    if (left > 2 * LANES) mhe_subtract_tile(rows, 3, whole, factors, above, to);
    else if (left > LANES) mhe_subtract_tile(rows, 2, whole, factors, above, to);
    else if (left > 0) mhe_subtract_tile(rows, 1, whole, factors, above, to);
}

/* Subtract C' D^-1 C from the upper half of the next block, for the coupling C of a panel. */
static void mhe_subtract(const real *panel, const real *inverse, real *next)
{
    int r = 0;
    for (; r + LANES <= NX; r += LANES) mhe_subtract_rows(LANES, r, panel, inverse, next);
    if (NX % LANES) mhe_subtract_rows(NX % LANES, r, panel, inverse, next);
}
#endif
