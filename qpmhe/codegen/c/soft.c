/* A term of J: penalties of rows that may be missed. Of the settings: what a miss of each row of a
 * stage and its square cost, an infinite amount where the row is hard.
 *
 * Half of J is the objective of a QP. In it, a soft row at its limit has a force of at most half its
 * linear penalty; one that is missed has this force, and one by its quadratic penalty. */

@mhe_trial
    mhe_real penalty; /* the part of the cost that soft rows add */
@mhe_side
    /* Of soft rows: how far the limit gives way, the dual of that, and the limit itself. */
    mhe_real miss[MHE_ROWS], pull[MHE_ROWS], miss_change[MHE_ROWS], pull_change[MHE_ROWS];
    mhe_real miss_correction[MHE_ROWS], limit_itself[MHE_ROWS];
@mhe_rows
    /* Of soft rows: the largest force of one that is not missed, and what it grows by beyond; and by
     * what second-order corrections have shifted and tightened them. */
    mhe_real most[MHE_ROWS], bend[MHE_ROWS], shift[MHE_ROWS], margin[MHE_ROWS];
@
/* Places of soft rows that are missed, beside those of the active set. */
enum { BELOW = -3, ABOVE = 3 };

/* Whether a row of a stage may be missed. */
static int mhe_is_soft(const mhe_settings *s, int r) { return isfinite(s->soft.linear[r]); }

/* The factor of the penalties of row stage i. */
static real mhe_soft_factor(const mhe_estimator *e, const mhe_workspace *k, int i)
{
    return i < e->length ? k->factors[i + 1] : 1;
}

/* The penalties' forces of the window's rows. */
static void mhe_soft_begin(mhe_estimator *e, mhe_workspace *k)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const real factor = mhe_soft_factor(e, k, i);
        for (int r = 0; r < ROWS; r++) {
            const int soft = mhe_is_soft(s, r), at = i * ROWS + r;
            k->rows.most[at] = soft ? factor * s->soft.linear[r] / 2 : INFINITY;
            k->rows.bend[at] = soft ? factor * s->soft.quadratic[r] : 0;
        }
    }
}

/* What they add to J of a trial, which keeps it. */
static real mhe_soft_cost(mhe_estimator *e, const mhe_workspace *k, mhe_trial *trial)
{
    const mhe_settings *s = e->settings;
    real cost = 0, low[ROWS], high[ROWS];
    for (int i = 0; i < mhe_row_stages(e); i++) {
        real sum = 0;
        mhe_stage_distances(e, i, trial->x, trial->w, trial, low, high);
        for (int r = 0; r < ROWS; r++) {
            const real missed = mhe_max(low[r], -high[r]);
            if (missed > 0 && mhe_is_soft(s, r))
                sum += missed * (s->soft.linear[r] + s->soft.quadratic[r] * missed);
        }
        cost += mhe_soft_factor(e, k, i) * sum;
    }
    trial->penalty = isnan(cost) ? INFINITY : cost;
    return trial->penalty;
}

/* The QP has them as rows. */
static void mhe_soft_add(const mhe_estimator *e, mhe_workspace *k, real factor, real *matrix,
                         int width)
{
    (void)e; (void)k; (void)factor; (void)matrix; (void)width;
}

/* Whether the spare trial is missed by curvature of soft rows: its penalty is larger, by more than
 * rounding in a row at its limit. */
static int mhe_is_bent(const mhe_outcome *o)
{
    const real rounding = MHE_ROUNDING * fabs(o->spare->cost);
    return o->best->penalty + rounding < o->spare->penalty && isfinite(o->spare->penalty);
}

static int mhe_is_violated(const mhe_rows *q, int i)
{
    return q->place[i] == BELOW || q->place[i] == ABOVE;
}

/* The QP for the nearest point has no soft rows; another one has them as they are linearised. */
static void mhe_begin_soft(mhe_estimator *e, mhe_workspace *k, int nearest, int again)
{
    mhe_rows *q = &k->rows;
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) {
        if (!isfinite(q->most[i])) continue;
        if (nearest) q->low[i] = -INFINITY, q->high[i] = INFINITY;
        if (!again) q->shift[i] = q->margin[i] = 0;
    }
}

/* A row that was missed in the QP before is so in the first guess, too. */
static void mhe_guess_soft(mhe_rows *q, int i, int before)
{
    if (!isfinite(q->most[i]) || q->place[i] == BETWEEN) return;
    if (before != BELOW && before != ABOVE) return;
    q->place[i] = (int8_t)before;
    q->force[i] = before < 0 ? -q->most[i] : q->most[i];
}

/* Weights of rows that are missed. */
static void mhe_soften(mhe_estimator *e, mhe_workspace *k)
{
    mhe_rows *q = &k->rows;
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++)
        if (mhe_is_violated(q, i)) q->weight[i] = q->bend[i];
}

/* These alone; whether there are any. */
static int mhe_set_missed_weights(mhe_estimator *e, mhe_workspace *k)
{
    int any = 0;
    memset(k->rows.weight, 0, sizeof k->rows.weight);
    mhe_soften(e, k);
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) any |= k->rows.weight[i] > 0;
    return any;
}

/* The place of a soft row that its solution asks for: between its limits, at one, or missed, one after
 * the other. Without a linear penalty no force holds it at a limit. */
static void mhe_compare_soft(const mhe_rows *q, int i, int *next)
{
    const int place = q->place[i], either = q->low[i] == q->high[i];
    const real most = q->most[i], force = q->force[i];
    if (!isfinite(most)) return;
    if (place == ABOVE)
        *next = q->value[i] >= q->high[i] ? ABOVE : either ? EQUATION : AT_UPPER;
    else if (place == BELOW)
        *next = q->value[i] <= q->low[i] ? BELOW : either ? EQUATION : AT_LOWER;
    else if (place != BETWEEN && force > most)
        *next = ABOVE;
    else if (place != BETWEEN && force < -most)
        *next = BELOW;
    if (most > 0 || either) return;
    if (place == BETWEEN && *next != BETWEEN) *next *= ABOVE;
    if (*next == AT_UPPER || *next == AT_LOWER) *next = BETWEEN;
}

/* Whether so many wrong places say that an interior point gets there sooner: three places make more
 * ways to go astray than two. */
static int mhe_is_lost(int wrong) { return wrong > FEW; }

/* The force of a row that comes to be missed. */
static void mhe_enter_soft(mhe_rows *q, int i)
{
    if (mhe_is_violated(q, i)) q->force[i] = q->place[i] < 0 ? -q->most[i] : q->most[i];
}

/* Whether an active row, of those that exclude each other, can be missed where its force grows. */
static int mhe_give_way(mhe_rows *q, int i, real gap, real little)
{
    if (!isfinite(q->most[i])) return 0;
    if (q->place[i] >= 0 && gap > little) q->next[i] = ABOVE;
    if (q->place[i] != AT_UPPER && gap < -little) q->next[i] = BELOW;
    return q->next[i] != q->place[i];
}

/* The penalty of the linearised rows at the step, where rows.value = c(step). */
static real mhe_linear_penalty(const mhe_estimator *e, const mhe_rows *q)
{
    real penalty = 0;
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) {
        const real missed = mhe_max(q->low[i] - q->value[i], q->value[i] - q->high[i]);
        if (missed > 0 && isfinite(q->most[i]))
            penalty += missed * (2 * q->most[i] + q->bend[i] * missed);
    }
    return penalty;
}

/* The force of a row, with that of its quadratic penalty where it is missed. */
static real mhe_whole_force(const mhe_rows *q, int i)
{
    if (!mhe_is_violated(q, i)) return q->force[i];
    return q->force[i] + q->bend[i] * (q->value[i] - mhe_limit_of(q, i));
}

/* The decrease of J that the QP promises. */
static real mhe_promised(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o)
{
    const real objective = mhe_twice_objective(e, k);
    return mhe_max(o->best->penalty - objective - mhe_linear_penalty(e, &k->rows), 0);
}

/* Second-order corrections: soft rows have a margin by the shifts of their limits alone, where
 * rows.value is the curvature. */
static void mhe_bend_soft(mhe_estimator *e, mhe_workspace *k)
{
    mhe_rows *q = &k->rows;
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) {
        if (!isfinite(q->most[i])) continue;
        const real more = MHE_BEYOND * fabs(q->value[i] - q->shift[i]);
        if (q->high[i] - q->low[i] - 2 * q->margin[i] > 4 * more) q->margin[i] += more;
        q->shift[i] = q->value[i];
        q->low[i] += q->margin[i];
        q->high[i] -= q->margin[i];
        q->load[i] = q->value[i] = 0;
    }
}

/* Soft rows of the interior point. The limit of a side gives way by a miss s >= 0, which costs
 * most s + bend s^2 / 2. With the dual t of s >= 0, Newton's equations are, beside those of a hard row,
 *
 *     most + bend s - dual - t = 0,   s t = target
 *
 * and s and t are eliminated. */

static int mhe_is_elastic(const mhe_rows *q, int i) { return isfinite(q->most[i]); }

static int mhe_gives_way(const mhe_rows *q, const mhe_side *p, int i)
{
    return mhe_is_elastic(q, i) && p->there[i] != 0;
}

/* Misses and their duals at the start, with the products of slacks and duals; their number. */
static int mhe_start_soft(mhe_rows *q, int rows, real missed, real product)
{
    int count = 0;
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            p->limit_itself[i] = p->limit[i];
            p->miss[i] = mhe_max(-p->limit[i], missed * q->scale[i]);
            p->pull[i] = product / p->miss[i];
            p->miss_correction[i] = 0;
            count++;
        }
    }
    return count;
}

static void mhe_raise_limits(mhe_rows *q, int rows)
{
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            p->limit[i] = p->limit_itself[i] + p->miss[i];
            p->miss_correction[i] = 0;
        }
    }
}

/* What the miss of a side resists its change with, and pushes it by. */
static real mhe_resistance(const mhe_rows *q, const mhe_side *p, int i)
{
    return q->bend[i] + p->pull[i] / p->miss[i];
}

static real mhe_push_miss(const mhe_rows *q, const mhe_side *p, int i, real target)
{
    const real force = q->most[i] + q->bend[i] * p->miss[i] - p->dual[i];
    return (target - p->miss_correction[i]) / p->miss[i] - force;
}

/* Weights of rows whose limits give way, none of which rounding makes negative; the sum of the products
 * of misses and their duals. */
static real mhe_soften_weights(mhe_rows *q, int rows)
{
    real products = 0;
    for (int i = 0; i < rows; i++)
        if (mhe_is_elastic(q, i)) q->weight[i] = 0;
    for (int side = 0; side < 2; side++) {
        const mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            const real stiff = p->dual[i] * p->inverse[i], soft = mhe_resistance(q, p, i);
            q->weight[i] += stiff * (soft / (soft + stiff));
            products += p->miss[i] * p->pull[i];
        }
    }
    return products;
}

/* The change of a dual, but for what the row's value changes by. */
static real mhe_soft_dual(const mhe_rows *q, const mhe_side *p, int i, real target)
{
    const real stiff = p->dual[i] * p->inverse[i], soft = mhe_resistance(q, p, i);
    const real hard = (target - p->correction[i]) * p->inverse[i] - p->dual[i];
    const real push = mhe_push_miss(q, p, i, target);
    return (soft * (hard - stiff * p->residual[i]) - stiff * push) / (soft + stiff);
}

static void mhe_soften_loads(mhe_rows *q, int rows, real target)
{
    for (int side = 0; side < 2; side++) {
        const mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            const real hard = (target - p->correction[i] - p->dual[i] * p->residual[i]) *
                                  p->inverse[i] - p->dual[i];
            q->load[i] += (side ? -1 : 1) * (mhe_soft_dual(q, p, i, target) - hard);
        }
    }
}

/* Changes along the direction, whose c is in rows.value. */
static void mhe_change_soft(mhe_rows *q, int rows, int side, real target)
{
    mhe_side *p = q->sides + side;
    for (int i = 0; i < rows; i++) {
        if (!mhe_gives_way(q, p, i)) continue;
        const real stiff = p->dual[i] * p->inverse[i], soft = mhe_resistance(q, p, i);
        const real moved = (side ? -1 : 1) * q->value[i];
        const real dual = mhe_soft_dual(q, p, i, target) - stiff * (soft / (soft + stiff)) * moved;
        const real miss = (dual + mhe_push_miss(q, p, i, target)) / soft;
        p->dual_change[i] = dual;
        p->miss_change[i] = miss;
        p->slack_change[i] += miss;
        p->pull_change[i] = (target - p->miss_correction[i] - p->pull[i] * miss) / p->miss[i] -
                            p->pull[i];
    }
}

/* The inverse of the longest step that keeps misses and their duals positive. */
static void mhe_shorten_soft(const mhe_rows *q, int rows, real *largest)
{
    for (int side = 0; side < 2; side++) {
        const mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            *largest = mhe_max(-p->miss_change[i] / p->miss[i], *largest);
            *largest = mhe_max(-p->pull_change[i] / p->pull[i], *largest);
        }
    }
}

static real mhe_correct_soft(mhe_rows *q, int rows, real length)
{
    real after = 0;
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            after += (p->miss[i] + length * p->miss_change[i]) *
                     (p->pull[i] + length * p->pull_change[i]);
            p->miss_correction[i] = length * length * p->miss_change[i] * p->pull_change[i];
        }
    }
    return after;
}

static void mhe_move_soft(mhe_rows *q, int rows, real length)
{
    for (int side = 0; side < 2; side++) {
        mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            p->miss[i] += length * p->miss_change[i];
            p->pull[i] += length * p->pull_change[i];
        }
    }
}

/* The largest square of a force on a miss, beyond rounding, by its resistance. */
static void mhe_balance_soft(const mhe_rows *q, int rows, real *unbalanced)
{
    for (int side = 0; side < 2; side++) {
        const mhe_side *p = q->sides + side;
        for (int i = 0; i < rows; i++) {
            if (!mhe_gives_way(q, p, i)) continue;
            const real force = q->most[i] + q->bend[i] * p->miss[i], other = p->dual[i] + p->pull[i];
            const real open = mhe_max(fabs(force - other) - 8 * EPSILON * (force + other), 0);
            *unbalanced = mhe_max(open * open / mhe_resistance(q, p, i), *unbalanced);
        }
    }
}

/* The place of a row in a solution: one whose limit has given way is missed. */
static void mhe_place_soft(mhe_rows *q, int i)
{
    const real square = q->scale[i] * q->scale[i];
    for (int side = 0; side < 2; side++) {
        const mhe_side *p = q->sides + side;
        if (!mhe_gives_way(q, p, i) || q->place[i] != (side ? AT_UPPER : AT_LOWER)) continue;
        if (p->miss[i] > square * p->pull[i]) q->place[i] = side ? ABOVE : BELOW;
    }
}

/* Whether an interior point that rounding keeps from its tolerance knows the active rows: with the
 * misses it has more products to bring to zero. */
static int mhe_is_nearly_solved(real products, real scale) { return products <= STUCK * scale; }

/* Forces of rows in a solution of the interior point. */
static void mhe_recall_forces(const mhe_estimator *e, mhe_workspace *k)
{
    mhe_rows *q = &k->rows;
    mhe_rows_times(e, k, k->step);
    for (int i = 0; i < mhe_row_stages(e) * ROWS; i++) {
        q->force[i] = q->sides[1].dual[i] - q->sides[0].dual[i];
        q->place[i] = BETWEEN; /* the dual of a row that is missed is all of its force */
    }
}
