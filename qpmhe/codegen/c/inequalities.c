/* What becomes of a QP. */
enum { SOLVED, STOPPED, UNCONSTRAINED, FAILED, EXCLUDED };

/* The QP with inequalities: a primal-dual active-set method, and where that does not settle an
 * interior-point method of Mehrotra's kind. The matrices of both have the form of factor.c, or of
 * elimination.c where some directions have no disturbance.
 *
 *     min d'H d / 2 + g'd   s.t.   low <= c(d) <= high
 *
 * The rows c of stage i are those of W (on d(i+1) - A d(i)), of V (on -C d(i)) and of X (on d(i)):
 * each set's components first, then its general inequalities. The last stage has rows of X only;
 * its places for others are without limits. */

/* Iterations in which residuals must shrink to a share, and those that are left more time: near a
 * vertex, they may linger. */
#define STALL 4
#define SHARE (real)0.8
#define SMALL (real)1e-3
#define FARTHEST (sizeof(real) == 8 ? (real)1e7 : (real)1e3)

/* Guesses of the active rows, and rounds of the augmented Lagrangian for each; each round makes
 * the rows' gaps smaller by about this factor. */
#define STUCK (sizeof(real) == 8 ? (real)1e-8 : (real)1e-3)
#define GUESSES 25
#define PATIENCE 2
#define FEW 10
#define ROUNDS 20
#define STIFFNESS (sizeof(real) == 8 ? (real)1e6 : (real)1e3)
#if MHE_ROLLED /* reflections bear more */
#define STIFFER STIFFNESS
#else
#define STIFFER (sizeof(real) == 8 ? (real)1e3 : (real)1e2)
#endif

#if CONSTRAINED

#if MHE_ROLLED
/* Whether a row of a stage is one on a direction that has no disturbance in any trial. */
static int mhe_is_eliminated(const mhe_settings *s, int r)
{
    const mhe_w_set *set = &s->disturbances;
    return r < NX ? set->lower[r] == set->upper[r] : r < W_COUNT && set->row_fixed[r - NX];
}
#endif

/* Limits of all rows about a trajectory x with residuals w and v. */
static void mhe_set_limits(mhe_estimator *e, mhe_workspace *k, const real *x, const real *w,
                           const real *v)
{
    real low[ROWS], high[ROWS];
    for (int i = 0; i < mhe_row_stages(e); i++) {
        mhe_stage_scales(e, i, k->rows.scale + i * ROWS, k->rows.deviation + i * ROWS);
        mhe_stage_distances(e, i, x, w, v, low, high);
        for (int r = 0; r < ROWS; r++) {
            const int at = i * ROWS + r, out = k->left_out[at];
            k->rows.low[at] = out & MHE_LOWER ? -INFINITY : low[r];
            k->rows.high[at] = out & MHE_UPPER ? INFINITY : high[r];
#if MHE_ROLLED
            if (!mhe_is_eliminated(e->settings, r)) continue;
            k->rows.low[at] = -INFINITY;
            k->rows.high[at] = INFINITY;
#endif
        }
    }
#if MHE_ROLLED
    k->limits_w = w;
#endif
}

static void mhe_values_of(int n, int count, const real *q, const real *rows, real *out)
{
    for (int j = 0; j < n; j++) out[j] = q[j];
    for (int i = 0; i < count; i++) out[n + i] = mhe_dot(n, rows + i * n, q);
}

/* rows.value = c(d). */
static void mhe_rows_times(const mhe_estimator *e, mhe_workspace *k, const real *d)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        real *value = k->rows.value + i * ROWS;
        const real *own = d + i * NX;
#if MHE_X_SET
        mhe_values_of(NX, MHE_X_ROWS, own, s->states.rows, value + W_COUNT + V_COUNT);
        if (i == e->length) {
            for (int r = 0; r < W_COUNT + V_COUNT; r++) value[r] = 0;
            break;
        }
#endif
#if MHE_W_SET
        real q[NX];
        for (int j = 0; j < NX; j++)
            q[j] = own[NX + j] - mhe_dot(NX, k->at[i]->f_jacobian + j * NX, own);
        mhe_values_of(NX, MHE_W_ROWS, q, s->disturbances.rows, value);
        value += W_COUNT;
#endif
#if MHE_V_SET
        real r[NY];
        for (int j = 0; j < NY; j++) r[j] = -mhe_dot(NX, k->at[i]->h_jacobian + j * NX, own);
        mhe_values_of(NY, MHE_V_ROWS, r, s->noises.rows, value);
#endif
    }
    (void)s;
}

static void mhe_loads_of(int n, int count, const real *rows, const real *load, real *out)
{
    for (int j = 0; j < n; j++) out[j] = load[j];
    for (int i = 0; i < count; i++)
        for (int j = 0; j < n; j++) out[j] += load[n + i] * rows[i * n + j];
}

/* out += c' load. */
static void mhe_add_loads(const mhe_estimator *e, const mhe_workspace *k, real *out)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const real *load = k->rows.load + i * ROWS;
        real *own = out + i * NX;
#if MHE_X_SET
        real x[NX];
        mhe_loads_of(NX, MHE_X_ROWS, s->states.rows, load + W_COUNT + V_COUNT, x);
        for (int j = 0; j < NX; j++) own[j] += x[j];
        if (i == e->length) break;
#endif
#if MHE_W_SET
        real w[NX];
        const real *A = k->at[i]->f_jacobian;
        mhe_loads_of(NX, MHE_W_ROWS, s->disturbances.rows, load, w);
        for (int r = 0; r < NX; r++) {
            if (w[r] == 0) continue;
            own[NX + r] += w[r];
            for (int j = 0; j < NX; j++) own[j] -= w[r] * A[r * NX + j];
        }
        load += W_COUNT;
#endif
#if MHE_V_SET
        real v[NY];
        const real *C = k->at[i]->h_jacobian;
        mhe_loads_of(NY, MHE_V_ROWS, s->noises.rows, load, v);
        for (int r = 0; r < NY; r++)
            for (int j = 0; j < NX; j++) own[j] -= v[r] * C[r * NX + j];
#endif
    }
    (void)s;
}

/* The place of a row in the active set: at its lower or upper limit, or between them. Of an
 * equation, the limits are the same. */
enum { AT_LOWER = -1, BETWEEN = 0, AT_UPPER = 1, EQUATION = 2 };

#if MHE_X_SET
/* The diagonal of the Hessian's block of d(i). */
static void mhe_stage_curvature(mhe_estimator *e, const mhe_workspace *k, int i, real *diagonal)
{
#if MHE_ROLLED
    const mhe_settings *s = e->settings;
    for (int j = 0; j < NX; j++) diagonal[j] = 0;
    if (i == 0)
        for (int j = 0; j < NX; j++) diagonal[j] = k->factors[0] * k->prior.weight[j * NX + j];
    else
        for (int j = 0; j < NX; j++)
            diagonal[j] = k->factors[i] * mhe_scaled(mhe_disturbance_weight(
                s, mhe_stage_at(e, i - 1))[j * NX + j], k->at[i - 1]->disturbance_scale, j);
    if (i == e->length) return;
    const mhe_terms *t = k->at[i];
    const real *Q = mhe_disturbance_weight(s, mhe_stage_at(e, i));
    const real *R = mhe_stage_at(e, i)->noise_weight, next = k->factors[i + 1];
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++) {
            const real weight = next * mhe_scaled(Q[r * NX + c], t->disturbance_scale, r);
            for (int j = 0; j < NX; j++)
                diagonal[j] += weight * t->f_jacobian[r * NX + j] * t->f_jacobian[c * NX + j];
        }
    for (int r = 0; r < NY; r++)
        for (int c = 0; c < NY; c++) {
            const real weight = next * mhe_scaled(R[r * NY + c], t->noise_scale, r);
            for (int j = 0; j < NX; j++)
                diagonal[j] += weight * t->h_jacobian[r * NX + j] * t->h_jacobian[c * NX + j];
        }
#else
    const real *panel = k->panels + i * NX * WIDTH;
    for (int j = 0; j < NX; j++) diagonal[j] = panel[j * WIDTH + j];
    (void)e;
#endif
}
#endif

/* Weights of the active rows. Those of W and V have the standard deviation of a disturbance or
 * noise. Rows of X have only that of the prior, which may be vague: so they are stiffer than what
 * the Hessian opposes to them. */
static void mhe_set_stiffness(mhe_estimator *e, mhe_workspace *k)
{
    mhe_rows *q = &k->rows;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const int own = i * ROWS;
        for (int at = own; at < own + ROWS; at++)
            q->weight[at] =
                q->place[at] == BETWEEN ? 0 : STIFFNESS / (q->deviation[at] * q->deviation[at]);
#if MHE_X_SET
        const int first = own + W_COUNT + V_COUNT;
        real diagonal[NX];
        int active = 0;
        for (int r = 0; r < NX + MHE_X_ROWS; r++) active += q->place[first + r] != BETWEEN;
        if (!active) continue;
        mhe_stage_curvature(e, k, i, diagonal);
        for (int j = 0; j < NX; j++)
            if (q->place[first + j] != BETWEEN) q->weight[first + j] = STIFFER * diagonal[j];
        for (int r = 0; r < MHE_X_ROWS; r++) {
            const real *row = e->settings->states.rows + r * NX;
            real pliancy = 0;
            if (q->place[first + NX + r] == BETWEEN) continue;
            for (int j = 0; j < NX; j++)
                if (row[j] != 0) pliancy += row[j] * row[j] / diagonal[j];
            q->weight[first + NX + r] = STIFFER / pliancy;
        }
#endif
    }
}

#if !MHE_ROLLED
/* panel += weight a a' (upper half). */
static void mhe_add_square(real *panel, real weight, const real *a)
{
    for (int i = 0; i < NX; i++) {
        const real scaled = weight * a[i];
        if (scaled == 0) continue;
        for (int j = i & ~3; j < NX; j++) panel[i * WIDTH + j] += scaled * a[j];
    }
}

/* panels += c' diag(weight) c. */
static void mhe_add_weights(const mhe_estimator *e, mhe_workspace *k)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const real *weights = k->rows.weight + i * ROWS;
        real *panel = k->panels + i * NX * WIDTH;
#if MHE_X_SET
        const real *bounds = weights + W_COUNT + V_COUNT;
        for (int j = 0; j < NX; j++) panel[j * WIDTH + j] += bounds[j];
        for (int r = 0; r < MHE_X_ROWS; r++)
            if (bounds[NX + r] != 0) mhe_add_square(panel, bounds[NX + r], s->states.rows + r * NX);
        if (i == e->length) break;
#endif
#if MHE_W_SET
        const real *A = k->at[i]->f_jacobian;
        real *next = panel + NX * WIDTH;
        for (int r = 0; r < NX; r++) {
            const real weight = weights[r];
            if (weight == 0) continue;
            mhe_add_square(panel, weight, A + r * NX);
            next[r * WIDTH + r] += weight;
            for (int j = 0; j < NX; j++) panel[j * WIDTH + NX + r] -= weight * A[r * NX + j];
        }
        for (int r = 0; r < MHE_W_ROWS; r++) {
            const real weight = weights[NX + r], *row = s->disturbances.rows + r * NX;
            real a[NX];
            if (weight == 0) continue;
            for (int j = 0; j < NX; j++) {
                a[j] = 0;
                for (int q = 0; q < NX; q++) a[j] -= row[q] * A[q * NX + j];
            }
            mhe_add_square(panel, weight, a);
            mhe_add_square(next, weight, row);
            for (int j = 0; j < NX; j++)
                for (int q = 0; q < NX; q++)
                    panel[j * WIDTH + NX + q] += weight * a[j] * row[q];
        }
        weights += W_COUNT;
#endif
#if MHE_V_SET
        const real *C = k->at[i]->h_jacobian;
        for (int r = 0; r < NY; r++)
            if (weights[r] != 0) mhe_add_square(panel, weights[r], C + r * NX);
        for (int r = 0; r < MHE_V_ROWS; r++) {
            const real *row = s->noises.rows + r * NY;
            real c[NX];
            if (weights[NY + r] == 0) continue;
            for (int j = 0; j < NX; j++) {
                c[j] = 0;
                for (int q = 0; q < NY; q++) c[j] += row[q] * C[q * NX + j];
            }
            mhe_add_square(panel, weights[NY + r], c);
        }
#endif
    }
    (void)s;
}

/* out = H d, from the panels before they are factorised. */
static void mhe_hessian_times(const mhe_workspace *k, int count, const real *d, real *out)
{
    for (int j = 0; j < (count + 1) * NX; j++) out[j] = 0;
    for (int i = 0; i <= count; i++) {
        const real *panel = k->panels + i * NX * WIDTH;
        const int last = i < count ? 2 * NX : NX;
        for (int r = 0; r < NX; r++) {
            const real *row = panel + r * WIDTH, own = d[i * NX + r];
            real *target = out + i * NX;
            real sum = row[r] * own;
            for (int c = r + 1; c < last; c++) {
                sum += row[c] * d[i * NX + c];
                target[c] += row[c] * own;
            }
            target[r] += sum;
        }
    }
}

/* Factorise the QP around a trajectory, with the active rows' weights. */
static int mhe_factorise_weighted(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest,
                                  int active)
{
    mhe_build(e, k, offset, nearest);
    if (active) {
        mhe_set_stiffness(e, k);
        mhe_add_weights(e, k);
    }
    return mhe_factorise(k, e->length);
}

/* The increments that minimise the QP with the rows' loads, or these alone. */
static int mhe_solve_loaded(mhe_estimator *e, mhe_workspace *k, int nearest, int active)
{
    (void)nearest; /* the gradient is zero then */
    for (int j = 0; j < (e->length + 1) * NX; j++) k->step[j] = -k->gradient[j];
    if (active) mhe_add_loads(e, k, k->step);
    return mhe_solve(k, e->length, k->step);
}

static int mhe_solve_loads(mhe_estimator *e, mhe_workspace *k)
{
    memset(k->direction, 0, sizeof(real) * (size_t)(e->length + 1) * NX);
    mhe_add_loads(e, k, k->direction);
    return mhe_solve(k, e->length, k->direction);
}
#else
static int mhe_factorise_weighted(mhe_estimator *e, mhe_workspace *k, const real *offset, int nearest,
                                  int active)
{
    mhe_assemble(e, k, offset);
    if (nearest) memset(k->gradient, 0, sizeof k->gradient);
    if (active) mhe_set_stiffness(e, k);
    return mhe_factorise(e, k, active);
}

static int mhe_solve_loaded(mhe_estimator *e, mhe_workspace *k, int nearest, int active)
{
    (void)active; /* there are no rows without weights */
    mhe_set_targets(e, k, 0, nearest);
    return mhe_solve(e, k, 0, k->step);
}

static int mhe_solve_loads(mhe_estimator *e, mhe_workspace *k)
{
    return mhe_solve(e, k, 1, k->direction);
}
#endif

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
 * are in it. Without iterations, all rows are left out. */
static int mhe_first_guess(mhe_rows *q, int rows, int limit)
{
    int active = 0;
    for (int i = 0; i < rows; i++) {
        const int place = q->place[i];
        q->force[i] = 0;
        q->place[i] = place < 0 ? AT_LOWER : place > 0 ? AT_UPPER : BETWEEN;
        if (q->low[i] == q->high[i]) q->place[i] = EQUATION;
        else if (!(fabs(mhe_limit_of(q, i)) <= FARTHEST * q->deviation[i])) q->place[i] = BETWEEN;
        if (limit == 0) q->place[i] = BETWEEN;
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
    for (int i = rows - 1; i >= 0; i--) {
        if (q->next[i] == q->place[i]) continue;
        q->place[i] = q->next[i];
        if (q->place[i] == BETWEEN) q->force[i] = 0;
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
        q->force[i] += force;
        q->load[i] = -force;
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
        if (q->place[i] == BETWEEN || q->place[i] == EQUATION) continue;
        const real gap = -q->load[i] / q->weight[i];
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
    int active = mhe_first_guess(q, rows, limit);
    mhe_guess guess = {0, rows + 1, 0};
    for (*iterations = 0;; again = 0) {
        real open = 0, energy = 0, last = INFINITY;
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
        if (active) open = mhe_push_back(q, rows, &energy);
        mhe_compare(q, rows, tolerance, &guess);
        if (limit == 0 && guess.wrong) return UNCONSTRAINED;
        /* Forces are exact enough for a guess; not yet for a solution. */
        for (int round = 0; !guess.wrong && open > tolerance; round++) {
            if (energy > last * (1 - STUCK)) {
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
            if (open <= tolerance) mhe_compare(q, rows, tolerance, &guess);
        }
        if (!guess.wrong) return SOLVED;
        if (!mhe_next_guess(q, rows, &guess)) return STOPPED;
        active = 0;
        for (int i = 0; i < rows; i++) active += q->place[i] != BETWEEN;
    }
}

/* The sign of a row's value in the slack of one of its sides. */
static real mhe_sign(int side) { return side ? -1 : 1; }

/* Slacks and duals at the start, whose products are all the same; the number of sides. Far sides
 * are none, as beside their slacks residuals are only rounding: those that are many deviations away,
 * and many times farther than the minimiser without inequalities `reach`es, in scales. */
static int mhe_start(mhe_rows *q, int rows, real missed, real reach, real product)
{
    int sides = 0;
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            const real limit = side ? q->high[i] : -q->low[i];
            const real unit = mhe_max(reach * q->scale[i], q->deviation[i]);
            const int there = q->low[i] < q->high[i] && limit <= FARTHEST * unit;
            p->there[i] = there ? 1 : 0;
            p->limit[i] = there ? limit : 0;
            p->slack[i] = there ? mhe_max(limit, missed * q->scale[i]) : 1;
            p->dual[i] = there ? product / p->slack[i] : 0;
            sides += there;
        }
    }
    return sides;
}

/* Residuals, weights and loads where rows.value = c(d). Returns the sum of the products, and
 * the largest residual in its row's scale. Equations have no sides, but weight and force as in
 * the active-set method, the weight made stiffer by a factor. */
static real mhe_set_residuals(mhe_rows *q, int rows, real stiffer, real *infeasible)
{
    real products = 0, worst[STRANDS] = {0};
    for (int i = 0; i < rows; i++) {
        const int s = i % STRANDS, equation = q->low[i] == q->high[i];
        q->missed[i] = equation ? q->value[i] - q->high[i] : 0;
        q->weight[i] = equation ? stiffer * q->weight[i] : 0;
        q->load[i] = -q->force[i];
        worst[s] = mhe_max(fabs(q->missed[i]) / q->scale[i], worst[s]);
    }
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        const real sign = mhe_sign(side);
        for (int i = 0; i < rows; i++) {
            p->correction[i] = 0;
            p->residual[i] = p->there[i] * (sign * q->value[i] + p->limit[i] - p->slack[i]);
            p->inverse[i] = p->there[i] / p->slack[i];
            q->weight[i] += p->dual[i] * p->inverse[i];
            q->load[i] += sign * p->dual[i];
        }
        for (int i = 0; i < rows; i++) {
            const int s = i % STRANDS;
            worst[s] = mhe_max(fabs(p->residual[i]) / q->scale[i], worst[s]);
        }
        products += mhe_product(rows, p->slack, p->dual);
    }
    *infeasible = worst[0];
    for (int s = 1; s < STRANDS; s++) *infeasible = mhe_max(worst[s], *infeasible);
    return products;
}

/* Solve the Newton equations for a target of the complementarity products. */
static int mhe_set_direction(mhe_estimator *e, mhe_workspace *k, real target)
{
    const int rows = mhe_row_stages(e) * ROWS;
    mhe_rows *q = &k->rows;
    /* Elimination takes the loads as they are, not what they add to those in the residual. */
    for (int i = 0; i < rows; i++)
        q->load[i] = -q->weight[i] * q->missed[i] - (MHE_ROLLED ? q->force[i] : 0);
    for (int side = 0; side < 2; side++) {
        const mhe_side *p = q->sides + side;
        const real sign = mhe_sign(side);
        for (int i = 0; i < rows; i++)
            q->load[i] += sign * ((target - p->correction[i] - p->dual[i] * p->residual[i]) *
                                      p->inverse[i] - (MHE_ROLLED ? 0 : p->dual[i]));
    }
#if MHE_ROLLED
    return mhe_solve(e, k, 0, k->direction);
#else
    memcpy(k->direction, k->residual, sizeof(real) * (size_t)(e->length + 1) * NX);
    mhe_add_loads(e, k, k->direction);
    return mhe_solve(k, e->length, k->direction);
#endif
}

/* The largest square of a force on the increments that the rows' loads leave, by its curvature. The
 * forces are what `mhe_set_direction` balances. */
static real mhe_unbalanced(mhe_estimator *e, mhe_workspace *k, int nearest)
{
    const int size = (e->length + 1) * NX;
#if MHE_ROLLED
    mhe_set_targets(e, k, k->step, nearest);
    memset(k->residual, 0, sizeof(real) * (size_t)size);
    mhe_add_loads(e, k, k->residual);
    return mhe_largest_force(e, k);
#else
    real worst = 0;
    (void)nearest; /* the gradient is zero then */
    mhe_hessian_times(k, e->length, k->step, k->product);
    for (int j = 0; j < size; j++) k->residual[j] = -k->product[j] - k->gradient[j];
    mhe_add_loads(e, k, k->residual);
    for (int j = 0; j < size; j++) {
        const real curvature = k->panels[j * WIDTH + j % NX];
        worst = mhe_max(k->residual[j] * k->residual[j] / curvature, worst);
    }
    return worst;
#endif
}

/* Changes of slacks and duals along the direction, whose c is in rows.value; the length of the
 * longest step, up to the whole direction, that keeps all of them positive. */
static real mhe_set_changes(mhe_rows *q, int rows, real target)
{
    real worst[STRANDS], largest = 1;
    for (int s = 0; s < STRANDS; s++) worst[s] = 1;
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        const real sign = mhe_sign(side);
        for (int i = 0; i < rows; i++) {
            const real change = p->there[i] * sign * q->value[i] + p->residual[i];
            p->slack_change[i] = change;
            p->dual_change[i] =
                (target - p->correction[i] - p->dual[i] * change) * p->inverse[i] - p->dual[i];
        }
        for (int i = 0; i < rows; i++) {
            const int s = i % STRANDS;
            const real dual = p->dual[i] + (1 - p->there[i]);
            worst[s] = mhe_max(-p->slack_change[i] * p->inverse[i], worst[s]);
            worst[s] = mhe_max(-p->dual_change[i] / dual, worst[s]);
        }
    }
    for (int s = 0; s < STRANDS; s++) largest = mhe_max(worst[s], largest);
    return 1 / largest;
}

/* Second-order terms of a step of this length, and the sum of the products after it. */
static real mhe_set_corrections(mhe_rows *q, int rows, real length)
{
    real after = 0;
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        after += mhe_product(rows, p->slack, p->dual);
        after += length * mhe_product(rows, p->slack, p->dual_change);
        after += length * mhe_product(rows, p->slack_change, p->dual);
        after += length * length * mhe_product(rows, p->slack_change, p->dual_change);
        /* Of a step that was cut short, the whole second order would be misleading: with it
         * there are QPs on which the method cycles. */
        for (int i = 0; i < rows; i++)
            p->correction[i] = length * length * p->slack_change[i] * p->dual_change[i];
    }
    return mhe_max(after, 0);
}

/* The active set of a solution. */
static void mhe_set_places(mhe_rows *q, int rows)
{
    for (int i = 0; i < rows; i++) {
        const real square = q->scale[i] * q->scale[i];
        const mhe_side *lower = q->sides, *upper = q->sides + 1;
        q->place[i] = BETWEEN;
        if (lower->there[i] != 0 && lower->slack[i] < square * lower->dual[i]) q->place[i] = AT_LOWER;
        if (upper->there[i] != 0 && upper->slack[i] < square * upper->dual[i]) q->place[i] = AT_UPPER;
    }
}

/* Solve the QP whose limits and terms are in place; `step` is that of the minimiser without
 * inequalities. No unit matters: rows are compared with their scales, products of slacks and duals
 * with what the objective has to gain or to pay, gradients with the roots of the Hessian's
 * diagonal. */
static int mhe_interior_point(mhe_estimator *e, mhe_workspace *k, const real *offset,
                              int nearest, int limit, int *iterations)
{
    const mhe_settings *s = e->settings;
    const int size = (e->length + 1) * NX, rows = mhe_row_stages(e) * ROWS;
    mhe_rows *q = &k->rows;
    real far = INFINITY, stiffer = 1;
    const real missed = mhe_row_violation(e, k, k->step);
    const real promise = fabs(mhe_product(size, k->gradient, k->step));
    real reach = 0;
    if (!(missed > 0)) return SOLVED;
    for (int i = 0; i < rows; i++) reach = mhe_max(fabs(q->value[i]) / q->scale[i], reach);
    memset(k->step, 0, sizeof(real) * (size_t)size);
    memset(q->force, 0, sizeof q->force);
#if MHE_ROLLED
    (void)offset; /* roots and gradient are in place */
    mhe_set_curvatures(e, k);
#endif
    const real outside = mhe_row_violation(e, k, k->step);
    const real scale = mhe_max(promise, outside * outside);
    /* Generous products: from smaller ones it creeps on some QPs. */
    const int sides = mhe_start(q, rows, missed, reach, mhe_max(scale, EPSILON * EPSILON));
    if (!sides) return STOPPED;
    for (*iterations = 0;; ++*iterations) {
        real infeasible, length = 1, target = 0;
#if !MHE_ROLLED
        mhe_build(e, k, offset, nearest);
#endif
        mhe_rows_times(e, k, k->step);
        mhe_set_stiffness(e, k);
        const real products = mhe_set_residuals(q, rows, stiffer, &infeasible);
        stiffer = mhe_max(stiffer, scale / products);
        if (!(stiffer < STIFFNESS)) stiffer = STIFFNESS;
        const real unbalanced = mhe_unbalanced(e, k, nearest);
        if (infeasible <= s->solver_tolerance / 100 &&
            unbalanced <= s->solver_tolerance * s->solver_tolerance * scale &&
            products <= s->solver_tolerance / 1000 * scale) {
            mhe_set_places(q, rows);
            return SOLVED;
        }
        if (*iterations >= limit || mhe_time_is_up(k)) return STOPPED;
        /* Of rows that exclude each other, residuals hardly shrink. */
        if (*iterations % STALL == 0) {
            if (infeasible > SMALL && infeasible > SHARE * far) return STOPPED;
            far = infeasible;
        }
#if MHE_ROLLED
        if (!mhe_factorise(e, k, 1)) return *iterations ? STOPPED : FAILED;
#else
        mhe_add_weights(e, k);
        if (!mhe_factorise(k, e->length)) return *iterations ? STOPPED : FAILED;
#endif
        for (int corrector = 0; corrector < 2; corrector++) {
            if (!mhe_set_direction(e, k, target)) return *iterations ? STOPPED : FAILED;
            mhe_rows_times(e, k, k->direction);
            length = mhe_set_changes(q, rows, target);
            if (corrector) break;
            const real ratio = mhe_set_corrections(q, rows, length) / products;
            target = ratio * ratio * ratio * products / (real)sides;
        }
        length *= (real)0.995;
        if (!(length > 1e-10)) return STOPPED;
        for (int j = 0; j < size; j++) k->step[j] += length * k->direction[j];
        for (int i = 0; i < rows; i++)
            if (q->low[i] == q->high[i])
                q->force[i] += length * q->weight[i] * (q->missed[i] + q->value[i]);
        for (int side = 0; side < 2; side++) {
            mhe_side *p = q->sides + side;
            for (int i = 0; i < rows; i++) {
                p->slack[i] += length * p->slack_change[i];
                p->dual[i] += length * p->dual_change[i];
            }
        }
    }
}

#endif
