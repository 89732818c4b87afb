/* An interior-point method of Mehrotra's kind. */

/* Iterations in which residuals must shrink to a share, and those that are left more time: near a
 * vertex, they may linger. */
#define STALL 4
#define SHARE (real)0.8
#define SMALL (real)1e-3
/* Products at the start of the way to the nearest point, in squares of the miss. */
#define GENEROUS (real)1e4
/* Where rounding cannot bear the weights of such products beside the Hessian, it starts so many
 * times more, from products that are smaller by this factor. */
#define STARTS 4
#define SMALLER (real)1e-3

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
            const int is_side = q->low[i] < q->high[i] || mhe_is_elastic(q, i);
            const int there = is_side && limit <= FARTHEST * unit;
            p->there[i] = there ? 1 : 0;
            p->limit[i] = there ? limit : 0;
            p->slack[i] = there ? mhe_max(limit, missed * q->scale[i]) : 1;
            p->dual[i] = there ? product / p->slack[i] : 0;
            sides += there;
        }
    }
    sides += mhe_start_soft(q, rows, missed, product);
    return sides;
}

/* Whether both limits of a row are one, which it has to keep. */
static int mhe_is_equation(const mhe_rows *q, int i)
{
    return q->low[i] == q->high[i] && !mhe_is_elastic(q, i);
}

/* Residuals, weights and loads where rows.value = c(d). Returns the sum of the products, and
 * the largest residual in its row's scale. Equations have no sides, but weight and force as in
 * the active-set method, the weight made stiffer by a factor. */
static real mhe_set_residuals(mhe_rows *q, int rows, real stiffer, real *infeasible)
{
    real products = 0, worst[STRANDS] = {0};
    mhe_raise_limits(q, rows);
    for (int i = 0; i < rows; i++) {
        const int s = i % STRANDS, equation = mhe_is_equation(q, i);
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
    products += mhe_soften_weights(q, rows);
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
    mhe_soften_loads(q, rows, target);
    return mhe_solve_direction(e, k);
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
        mhe_change_soft(q, rows, side, target);
        for (int i = 0; i < rows; i++) {
            const int s = i % STRANDS;
            const real dual = p->dual[i] + (1 - p->there[i]);
            worst[s] = mhe_max(-p->slack_change[i] * p->inverse[i], worst[s]);
            worst[s] = mhe_max(-p->dual_change[i] / dual, worst[s]);
        }
    }
    for (int s = 0; s < STRANDS; s++) largest = mhe_max(worst[s], largest);
    mhe_shorten_soft(q, rows, &largest);
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
    after += mhe_correct_soft(q, rows, length);
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
        mhe_place_soft(q, i);
    }
}

/* What becomes of a QP from which rounding keeps the next step. */
static int mhe_give_up(mhe_rows *q, int rows, real products, real scale)
{
    (void)products; (void)scale;
    if (!mhe_is_nearly_solved(products, scale)) return STOPPED;
    mhe_set_places(q, rows);
    return NEARLY;
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
    mhe_begin_interior(e, k);
    (void)offset;
    const real outside = mhe_row_violation(e, k, k->step);
    const real scale = mhe_max(promise, outside * outside);
    /* Generous products: from smaller ones it creeps on some QPs. The way to the nearest point promises
     * nothing, and may cost much more than the square of the miss. */
    real product = (nearest ? GENEROUS : 1) * mhe_max(scale, EPSILON * EPSILON);
    const int sides = mhe_start(q, rows, missed, reach, product);
    int starts = 0;
    if (!sides) return STOPPED;
    for (*iterations = 0; *iterations <= limit; ++*iterations) {
        real infeasible, length = 1, target = 0;
        mhe_build_again(e, k, offset, nearest);
        mhe_rows_times(e, k, k->step);
        mhe_set_stiffness(e, k);
        const real products = mhe_set_residuals(q, rows, stiffer, &infeasible);
        stiffer = mhe_max(stiffer, scale / products);
        if (!(stiffer < STIFFNESS)) stiffer = STIFFNESS;
        real unbalanced = mhe_unbalanced(e, k, nearest);
        mhe_balance_soft(q, rows, &unbalanced);
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
        if (!mhe_factorise_rows(e, k)) {
            if (*iterations > starts) return mhe_give_up(q, rows, products, scale);
            if (starts == STARTS) return FAILED;
            starts++;
            product *= SMALLER;
            mhe_start(q, rows, missed, reach, product);
            continue;
        }
        for (int corrector = 0; corrector < 2; corrector++) {
            if (!mhe_set_direction(e, k, target))
                return *iterations ? mhe_give_up(q, rows, products, scale) : FAILED;
            mhe_rows_times(e, k, k->direction);
            length = mhe_set_changes(q, rows, target);
            if (corrector) break;
            const real ratio = mhe_set_corrections(q, rows, length) / products;
            target = ratio * ratio * ratio * products / (real)sides;
        }
        length *= (real)0.995;
        if (!(length > 1e-10)) return mhe_give_up(q, rows, products, scale);
        for (int j = 0; j < size; j++) k->step[j] += length * k->direction[j];
        for (int i = 0; i < rows; i++)
            if (mhe_is_equation(q, i))
                q->force[i] += length * q->weight[i] * (q->missed[i] + q->value[i]);
        for (int side = 0; side < 2; side++) {
            mhe_side *p = q->sides + side;
            for (int i = 0; i < rows; i++) {
                p->slack[i] += length * p->slack_change[i];
                p->dual[i] += length * p->dual_change[i];
            }
        }
        mhe_move_soft(q, rows, length);
    }
    return STOPPED;
}
