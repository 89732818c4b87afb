/* There are no soft rows. */

static int mhe_is_soft(const mhe_settings *s, int r)
{
    (void)s; (void)r;
    return 0;
}

static int mhe_is_bent(const mhe_outcome *o)
{
    (void)o;
    return 0;
}

static int mhe_is_violated(const mhe_rows *q, int i)
{
    (void)q; (void)i;
    return 0;
}

static real mhe_whole_force(const mhe_rows *q, int i) { return q->force[i]; }

static void mhe_begin_soft(mhe_estimator *e, mhe_workspace *k, int nearest, int again)
{
    (void)e; (void)k; (void)nearest; (void)again;
}

static void mhe_guess_soft(mhe_rows *q, int i, int before)
{
    (void)q; (void)i; (void)before;
}

static void mhe_soften(mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}

static int mhe_set_missed_weights(mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
    return 0;
}

static void mhe_compare_soft(const mhe_rows *q, int i, int *next)
{
    (void)q; (void)i; (void)next;
}

static void mhe_enter_soft(mhe_rows *q, int i)
{
    (void)q; (void)i;
}

static int mhe_give_way(mhe_rows *q, int i, real gap, real little)
{
    (void)q; (void)i; (void)gap; (void)little;
    return 0;
}

/* The decrease of J that the QP promises. */
static real mhe_promised(mhe_estimator *e, mhe_workspace *k, const mhe_outcome *o)
{
    (void)o;
    return fabs(mhe_dot((e->length + 1) * NX, k->gradient, k->step));
}

static void mhe_bend_soft(mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}

static int mhe_is_elastic(const mhe_rows *q, int i)
{
    (void)q; (void)i;
    return 0;
}

static int mhe_start_soft(mhe_rows *q, int rows, real missed, real product)
{
    (void)q; (void)rows; (void)missed; (void)product;
    return 0;
}

static void mhe_raise_limits(mhe_rows *q, int rows)
{
    (void)q; (void)rows;
}

static real mhe_soften_weights(mhe_rows *q, int rows)
{
    (void)q; (void)rows;
    return 0;
}

static void mhe_soften_loads(mhe_rows *q, int rows, real target)
{
    (void)q; (void)rows; (void)target;
}

static void mhe_change_soft(mhe_rows *q, int rows, int side, real target)
{
    (void)q; (void)rows; (void)side; (void)target;
}

static void mhe_shorten_soft(const mhe_rows *q, int rows, real *largest)
{
    (void)q; (void)rows; (void)largest;
}

static real mhe_correct_soft(mhe_rows *q, int rows, real length)
{
    (void)q; (void)rows; (void)length;
    return 0;
}

static void mhe_move_soft(mhe_rows *q, int rows, real length)
{
    (void)q; (void)rows; (void)length;
}

static void mhe_balance_soft(const mhe_rows *q, int rows, real *unbalanced)
{
    (void)q; (void)rows; (void)unbalanced;
}

static void mhe_place_soft(mhe_rows *q, int i)
{
    (void)q; (void)i;
}

static void mhe_recall_forces(const mhe_estimator *e, mhe_workspace *k)
{
    (void)e; (void)k;
}

static int mhe_is_lost(int wrong)
{
    (void)wrong;
    return 0;
}

static int mhe_is_nearly_solved(real products, real scale)
{
    (void)products; (void)scale;
    return 0;
}
