/* Equations of the stages, in one block of rows and columns for each state: some matrices minus
 * h times Jacobians. Without exchanges of rows, states are eliminated in an order that leaves most
 * blocks without entries; `near` lists, behind each state, those whose rows and columns then have
 * entries. Blocks lie by rows, and their entries, too. */

static const int mhe_order[NX] = {$order};
static const int mhe_near_start[NX + 1] = {$start};
static const int mhe_near[] = {$near};

/* Zeros where elimination needs entries. */
static void mhe_clear_blocks(int size, real *M)
{
    if ($full)
        for (int i = 0; i < NX * NX * size; i++) M[i] = 0;
    for (int p = 0; p < NX * !$full; p++) {
        const int c = mhe_order[p];
        for (int i = 0; i < size; i++) M[(c * NX + c) * size + i] = 0;
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++)
            for (int i = 0; i < size; i++)
                M[(c * NX + mhe_near[q]) * size + i] = M[(mhe_near[q] * NX + c) * size + i] = 0;
    }
}

/* Invert the block on the diagonal, last row first, and add the squares of the multipliers. */
static void mhe_invert_block(int size, real *D, real *squares)
{
    for (int k = size - 1; k >= 0; k--) {
        const real pivot = 1 / D[k * size + k];
        *squares += 0 * pivot; /* no number if it is none */
        D[k * size + k] = 1;
        for (int j = 0; j < size; j++) D[k * size + j] *= pivot;
        for (int i = 0; i < size; i++) {
            if (i == k) continue;
            const real factor = D[i * size + k], share = factor * pivot;
            D[i * size + k] = 0;
            for (int j = 0; j < size; j++) D[i * size + j] -= factor * D[k * size + j];
            if (i < k) *squares += share * share;
        }
    }
}

/* Eliminate in place; whether no multiplier is so large that rows should have been exchanged, in units
 * of the equations' sizes, of which `per` has the reciprocals. */
static int mhe_factor_blocks(int size, real *M, const real *per)
{
    real squares = 0;
    for (int p = 0; p < NX; p++) {
        const int c = mhe_order[p], *near = mhe_near + mhe_near_start[p];
        const int count = mhe_near_start[p + 1] - mhe_near_start[p];
        real *D = M + (c * NX + c) * size * size;
        mhe_invert_block(size, D, &squares);
        for (int q = 0; q < count; q++) {
            real *left = M + (near[q] * NX + c) * size * size, row[9], most = 0;
            const real ratio = per[near[q]] / per[c];
            for (int i = 0; i < size; i++)
                for (int j = 0; j < size; j++) {
                    real sum = 0;
                    for (int l = 0; l < size; l++) sum += left[i * size + l] * D[l * size + j];
                    row[i * size + j] = sum;
                    most += sum * sum;
                }
            for (int i = 0; i < size * size; i++) left[i] = row[i];
            squares += most * ratio * ratio;
            for (int o = 0; o < count; o++) {
                const real *right = M + (c * NX + near[o]) * size * size;
                real *to = M + (near[q] * NX + near[o]) * size * size;
                for (int i = 0; i < size; i++)
                    for (int j = 0; j < size; j++) {
                        real sum = 0;
                        for (int l = 0; l < size; l++) sum += row[i * size + l] * right[l * size + j];
                        to[i * size + j] -= sum;
                    }
            }
        }
    }
    return squares <= (real)$multipliers;
}

/* to -= block from, for NX columns. */
static void mhe_subtract_block(int size, const real *restrict block, const real *restrict from,
                               real *restrict to)
{
    for (int i = 0; i < size; i++)
        for (int k = 0; k < NX; k++) {
            real sum = to[i * NX + k];
            for (int j = 0; j < size; j++) sum -= block[i * size + j] * from[j * NX + k];
            to[i * NX + k] = sum;
        }
}

/* Solve for NX columns z, by rows, in place. */
static void mhe_solve_blocks(int size, const real *M, real *z)
{
    for (int p = 0; p < NX; p++) {
        const int c = mhe_order[p];
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++) {
            const int r = mhe_near[q];
            mhe_subtract_block(size, M + (r * NX + c) * size * size, z + c * size * NX, z + r * size * NX);
        }
    }
    for (int p = NX - 1; p >= 0; p--) {
        const int c = mhe_order[p];
        const real *D = M + (c * NX + c) * size * size;
        real *row = z + c * size * NX, held[3 * NX];
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++) {
            const int r = mhe_near[q];
            mhe_subtract_block(size, M + (c * NX + r) * size * size, z + r * size * NX, row);
        }
        for (int i = 0; i < size * NX; i++) held[i] = row[i];
        for (int i = 0; i < size; i++)
            for (int k = 0; k < NX; k++) {
                real sum = 0;
                for (int j = 0; j < size; j++) sum += D[i * size + j] * held[j * NX + k];
                row[i * NX + k] = sum;
            }
    }
}

/* The same for a single column. */
static void mhe_solve_one(int size, const real *M, real *z)
{
    for (int p = 0; p < NX; p++) {
        const real *from = z + mhe_order[p] * size;
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++) {
            const real *block = M + (mhe_near[q] * NX + mhe_order[p]) * size * size;
            real *to = z + mhe_near[q] * size;
            for (int i = 0; i < size; i++) {
                real sum = to[i];
                for (int j = 0; j < size; j++) sum -= block[i * size + j] * from[j];
                to[i] = sum;
            }
        }
    }
    for (int p = NX - 1; p >= 0; p--) {
        const int c = mhe_order[p];
        const real *D = M + (c * NX + c) * size * size;
        real *row = z + c * size, held[3];
        for (int i = 0; i < size; i++) held[i] = row[i];
        for (int q = mhe_near_start[p]; q < mhe_near_start[p + 1]; q++) {
            const real *block = M + (c * NX + mhe_near[q]) * size * size, *from = z + mhe_near[q] * size;
            for (int i = 0; i < size; i++)
                for (int j = 0; j < size; j++) held[i] -= block[i * size + j] * from[j];
        }
        for (int i = 0; i < size; i++) {
            real sum = 0;
            for (int j = 0; j < size; j++) sum += D[i * size + j] * held[j];
            row[i] = sum;
        }
    }
}
