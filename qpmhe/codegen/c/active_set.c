/* The QP with inequalities: a primal-dual active-set method, and where that does not settle an
 * interior-point method of Mehrotra's kind. The matrices of both have the form of factor.c, or of
 * elimination.c where some directions have no disturbance.
 *
 *     min d'H d / 2 + g'd   s.t.   low <= c(d) <= high
 *
 * The rows c of stage i are those of W (on d(i+1) - A d(i)), of V (on -C d(i)) and of X (on d(i)):
 * each set's components first, then its general inequalities. The last stage has rows of X only;
 * its places for others are without limits. */

/* Limits farther away, in deviations, are not in a first guess. */
#define FARTHEST (sizeof(real) == 8 ? (real)1e7 : (real)1e3)

/* Guesses of the active rows, and rounds of the augmented Lagrangian for each; each round makes
 * the rows' gaps smaller by about this factor. */
#define STUCK (sizeof(real) == 8 ? (real)1e-8 : (real)1e-3)
#define GUESSES 25
#define PATIENCE 2
#define FEW 10
#define ROUNDS 50

/* Rounds that leave more than this share of the last change only add rounding. */
#define SHRINKING (real)0.5

/* A solution is precise where the next round would move it by less than this share of its size. */
#define PRECISE (sizeof(real) == 8 ? (real)1e-10 : (real)1e-5)

/* pliancy[r] += a D^-1 a' for the active rows of a set, a its slope: components of the set are M d, or d
 * itself without M. */
static void mhe_add_pliancy(int d, int count, const real *M, const real *rows, const int8_t *place,
                            const real *D, real *pliancy)
{
    for (int r = 0; r < d + count; r++) {
        if (place[r] == BETWEEN) continue;
        for (int j = 0; j < NX; j++) {
            real slope = 0;
            for (int q = 0; q < d; q++) {
                const real share = r < d ? r == q : rows[(r - d) * d + q];
                if (share != 0) slope += share * (M ? M[q * NX + j] : q == j);
            }
            pliancy[r] += slope * slope / D[j];
        }
    }
}

/* Weights of the active rows: so many times what the Hessian, by its diagonal D, opposes to them.
 * Then the first forces are right to this share, each round leaves it of an error, and no more
 * digits are lost beside directions that hardly count in the Hessian. */
static void mhe_set_stiffness(mhe_estimator *e, mhe_workspace *k)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const int8_t *place = k->rows.place + i * ROWS;
        const real *deviation = k->rows.deviation + i * ROWS;
        real *weight = k->rows.weight + i * ROWS, D[NX];
        int active = 0;
        for (int r = 0; r < ROWS; r++) {
            weight[r] = 0;
            active += place[r] != BETWEEN;
        }
        if (!active) continue;
        mhe_stage_curvature(e, k, i, D);
        if (MHE_X_SET)
            mhe_add_pliancy(NX, MHE_X_ROWS, 0, s->states.rows, place + W_COUNT + V_COUNT, D,
                            weight + W_COUNT + V_COUNT);
        if (MHE_V_SET && i < e->length)
            mhe_add_pliancy(NY, MHE_V_ROWS, k->at[i]->h_jacobian, s->noises.rows, place + W_COUNT,
                            D, weight + W_COUNT);
        if (MHE_W_SET && i < e->length) {
            const real *rows = s->disturbances.rows;
            mhe_add_pliancy(NX, MHE_W_ROWS, k->at[i]->f_jacobian, rows, place, D, weight);
            mhe_stage_curvature(e, k, i + 1, D);
            mhe_add_pliancy(NX, MHE_W_ROWS, 0, rows, place, D, weight);
        }
        mhe_slope_stiffness(e, k, i, place + G_AT, weight + G_AT);
        for (int r = 0; r < ROWS; r++) { /* some outputs depend on no state */
            const real least = EPSILON * deviation[r];
            if (place[r] != BETWEEN) weight[r] = STIFFER / mhe_max(weight[r], least * least);
        }
    }
    mhe_soften(e, k);
    (void)s;
}

/* Rows of X or g that are missed by a share of the prior's deviation may be missed by much where the prior
 * is vague. Their scales become what the Hessian opposes to them, above rounding in their values.
 * Only where some row is active or missed: else no scale is asked for. */
static void mhe_sharpen(mhe_estimator *e, mhe_workspace *k, real tolerance)
{
    const real *rows = e->settings->states.rows;
    for (int i = 0; MHE_X_SET && i <= e->length; i++) {
        real *scale = k->rows.scale + i * ROWS + W_COUNT + V_COUNT, D[NX];
        const real *d = k->step + i * NX;
        mhe_stage_curvature(e, k, i, D);
        for (int r = 0; r < NX + MHE_X_ROWS; r++) {
            real pliancy = 0, size = 0;
            for (int j = 0; j < NX; j++) {
                const real slope = r < NX ? r == j : rows[(r - NX) * NX + j];
                pliancy += slope * slope / D[j];
                size += fabs(slope * d[j]);
            }
            const real least = mhe_max(sqrt(pliancy), 64 * EPSILON / tolerance * size);
            if (least < scale[r]) scale[r] = least;
        }
    }
    for (int i = 0; i < mhe_row_stages(e); i++)
        mhe_sharpen_values(e, k, i, 64 * EPSILON / tolerance);
}

static int mhe_is_missed(const mhe_rows *q, int rows)
{
    int missed = 0;
    for (int i = 0; i < rows; i++) missed |= (q->value[i] < q->low[i]) | (q->value[i] > q->high[i]);
    return missed;
}

/* The largest miss of a row in its scale; rows.value = c(d) afterwards. */
static real mhe_row_violation(const mhe_estimator *e, mhe_workspace *k, const real *d)
{
    const mhe_rows *q = &k->rows;
    real worst = 0;
    mhe_rows_times(e, k, d);
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) {
        const real missed = mhe_max(q->low[i] - q->value[i], q->value[i] - q->high[i]);
        if (missed > 0) worst = mhe_max(missed / q->scale[i], worst);
    }
    return worst;
}

/* Sums and maxima are taken in strands, side by side: one after the other, the latency of each
 * operation would be most of their time. */
#define STRANDS 8

static real mhe_product(int n, const real *a, const real *b)
{
    real sums[STRANDS] = {0};
    int i = 0;
    for (; i + STRANDS <= n; i += STRANDS)
        for (int s = 0; s < STRANDS; s++) sums[s] += a[i + s] * b[i + s];
    for (; i < n; i++) sums[0] += a[i] * b[i];
    for (int s = 1; s < STRANDS; s++) sums[0] += sums[s];
    return sums[0];
}

static real mhe_limit_of(const mhe_rows *q, int i)
{
    return q->place[i] == BETWEEN ? 0 : q->place[i] < 0 ? q->low[i] : q->high[i];
}

/* The first guess is the active set that was left there, as far as its limits exist; how many rows
 * are in it. Without iterations, all rows are left out. `again`: whether the last factor is theirs. */
static int mhe_first_guess(mhe_rows *q, int rows, int limit, int *again)
{
    int active = 0;
    for (int i = 0; i < rows; i++) {
        const int place = q->place[i];
        q->force[i] = 0;
        q->place[i] = place < 0 ? AT_LOWER : place > 0 ? AT_UPPER : BETWEEN;
        if (q->low[i] == q->high[i]) q->place[i] = EQUATION;
        else if (!(fabs(mhe_limit_of(q, i)) <= FARTHEST * q->deviation[i])) q->place[i] = BETWEEN;
        if (limit == 0) q->place[i] = BETWEEN;
        mhe_guess_soft(q, i, place);
        *again &= q->place[i] == place;
        active += q->place[i] != BETWEEN;
    }
    return active;
}

/* What the next guess is made from. */
typedef struct {
    int wrong, fewest; /* places that contradict the solution: now, and at best */
    int patience;      /* guesses in which they need not become fewer */
} mhe_guess;

/* Compare the places of rows with the solution for them. */
static void mhe_compare(mhe_rows *q, int rows, real tolerance, mhe_guess *guess)
{
    guess->wrong = 0;
    for (int i = 0; i < rows; i++) {
        const real little = tolerance * q->scale[i];
        int next = q->place[i];
        if (next == BETWEEN) {
            const real below = q->low[i] - q->value[i], above = q->value[i] - q->high[i];
            if (below > little) next = AT_LOWER;
            if (above > little) next = AT_UPPER;
        } else if (next != EQUATION && (next < 0 ? -q->force[i] : q->force[i]) < 0)
            next = BETWEEN;
        mhe_compare_soft(q, i, &next);
        q->next[i] = (int8_t)next;
        guess->wrong += next != q->place[i];
    }
}

/* Rows that are missed enter the active set, those that hold the solution back leave it: all of
 * them, as long as they become fewer, else only the last, until they are. So Judice and Pires
 * (Computers and Operations Research 21, 1994) keep such methods from cycling. 0 where one by one
 * would take too long. */
static int mhe_next_guess(mhe_rows *q, int rows, mhe_guess *guess)
{
    int all = 1;
    if (guess->wrong < guess->fewest)
        guess->fewest = guess->wrong, guess->patience = PATIENCE;
    else
        all = guess->patience-- > 0;
    if (!all && guess->fewest > FEW) return 0;
    if (guess->wrong > guess->fewest && mhe_is_lost(guess->wrong)) return 0;
    for (int i = rows - 1; i >= 0; i--) {
        if (q->next[i] == q->place[i]) continue;
        q->place[i] = q->next[i];
        if (q->place[i] == BETWEEN) q->force[i] = 0;
        mhe_enter_soft(q, i);
        if (!all) break;
    }
    return 1;
}

/* Add what the active rows miss their limits by to their forces, where rows.value = c(step), and
 * the next loads; the largest miss in a row's scale, beyond rounding. `energy`: the sum of their
 * weighted squares. */
static real mhe_push_back(mhe_rows *q, int rows, real *energy)
{
    real open = 0;
    *energy = 0;
    for (int i = 0; i < rows; i++) {
        if (q->place[i] == BETWEEN) {
            q->load[i] = 0;
            continue;
        }
        const real limit = mhe_limit_of(q, i), gap = q->value[i] - limit;
        const real force = q->weight[i] * gap;
        q->load[i] = -force;
        if (mhe_is_violated(q, i)) continue;
        q->force[i] += force;
        *energy += force * gap;
        open = mhe_max((fabs(gap) - 64 * EPSILON * fabs(limit)) / q->scale[i], open);
    }
    return open;
}

/* The number of inequalities that must leave the active set where its rows exclude each other:
 * those whose last change of force could not go on for ever. */
static int mhe_exclude(mhe_rows *q, int rows, real open)
{
    int changes = 0;
    for (int i = 0; i < rows; i++) {
        q->next[i] = q->place[i];
        if (q->place[i] == BETWEEN || mhe_is_violated(q, i)) continue;
        const real gap = -q->load[i] / q->weight[i];
        if (mhe_give_way(q, i, gap, STUCK * open * q->scale[i])) {
            changes++;
            continue;
        }
        if (q->place[i] == EQUATION) continue;
        if (gap * q->place[i] < -STUCK * open * q->scale[i]) q->next[i] = BETWEEN, changes++;
    }
    return changes;
}

/* Guess which rows are active, solve the QP with these as equations, guess anew: the primal-dual
 * active-set method of Hintermueller, Ito and Kunisch (SIAM Journal on Optimization 13, 2002),
 * which mostly ends after a few factorisations, with an exact solution. The equations are those of
 * an augmented Lagrangian, so that rows may depend on each other. The first guess
 * is in rows.place, from the QP before; with `again`, it is factorised. STOPPED where the guesses do not
 * settle, EXCLUDED where the rows exclude each other. */
static int mhe_active_set(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest,
                          int limit, int again, int *iterations)
{
    const int size = (e->length + 1) * NX, rows = mhe_row_stages(e) * ROWS;
    const real tolerance = e->settings->solver_tolerance / 100;
    mhe_rows *q = &k->rows;
    int active = mhe_first_guess(q, rows, limit, &again), sharp = 0;
    mhe_guess guess = {0, rows + 1, 0};
    /* Guesses without an active row are no iterations; behind each, some row is active. */
    *iterations = 0;
    for (int more = 2 * (limit < GUESSES ? limit : GUESSES) + 2; more > 0; more--, again = 0) {
        real open = 0, energy = 0, last = INFINITY, left = 0, moved = 0;
        if (active && (*iterations == limit || *iterations == GUESSES)) return STOPPED;
        *iterations += active > 0;
        if (!again) {
            if (active && mhe_time_is_up(k)) return STOPPED;
            if (!mhe_factorise_weighted(e, k, offset, nearest, active > 0)) return STOPPED;
        }
        for (int i = 0; i < rows; i++)
            q->load[i] = q->weight[i] * mhe_limit_of(q, i) - q->force[i];
        if (!mhe_solve_loaded(e, k, nearest, active > 0)) return STOPPED;
        mhe_rows_times(e, k, k->step);
        if (!active && !mhe_is_missed(q, rows)) return SOLVED;
        if (!sharp) {
            mhe_sharpen(e, k, tolerance);
            sharp = 1;
        }
        if (active) {
            open = mhe_push_back(q, rows, &energy);
            left = moved = mhe_size(e, k, k->step);
        }
        const real precise = PRECISE * moved;
        mhe_compare(q, rows, tolerance, &guess);
        if (limit == 0 && guess.wrong) return UNCONSTRAINED;
        /* Forces are exact enough for a guess; not yet for a solution. */
        int further = active ? MORE_ROUNDS : 0;
        for (int round = 0; !guess.wrong && round <= ROUNDS; round++) {
            if (!(open > tolerance || left > precise) && further-- <= 0) break;
            if (open > tolerance && energy > last * (1 - STUCK)) {
                guess.wrong = mhe_exclude(q, rows, open);
                if (!guess.wrong) return EXCLUDED;
                break;
            }
            if (round == ROUNDS) return STOPPED;
            last = energy;
            if (!mhe_solve_loads(e, k)) return STOPPED;
            for (int j = 0; j < size; j++) k->step[j] += k->direction[j];
            mhe_rows_times(e, k, k->step);
            open = mhe_push_back(q, rows, &energy);
            const real change = mhe_size(e, k, k->direction), share = change / moved;
            left = share < SHRINKING ? change * share : 0;
            moved = change;
            if (open <= tolerance) mhe_compare(q, rows, tolerance, &guess);
        }
        if (!guess.wrong) return SOLVED;
        if (!mhe_next_guess(q, rows, &guess)) return STOPPED;
        active = 0;
        for (int i = 0; i < rows; i++) active += q->place[i] != BETWEEN;
    }
    return STOPPED;
}
