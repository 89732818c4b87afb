/* There is no X for the observer to stay in. */

static int mhe_needs_slope(const mhe_estimator *e)
{
    (void)e;
    return 0;
}

static int mhe_stay_inside(mhe_estimator *e, int i, const mhe_x_set *onto, const real *predicted,
                           real *next)
{
    (void)e; (void)i; (void)onto; (void)predicted; (void)next;
    return 0;
}

static int mhe_move_state(mhe_estimator *e, const mhe_sample *sample)
{
    (void)e; (void)sample;
    return 0;
}

static void mhe_start_inside(mhe_estimator *e)
{
    (void)e;
}

static void mhe_put_first_inside(mhe_estimator *e)
{
    (void)e;
}

/* The observer's own estimate of x(t) that has used y(t). */
static void mhe_filter_inside(mhe_estimator *e, const mhe_stage *stage, real *out)
{
    mhe_filter(e->settings, stage, out, 0);
    mhe_enter_turn(e->settings, out);
}
