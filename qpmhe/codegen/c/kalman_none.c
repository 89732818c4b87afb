/* A covariance without roots. */

/* L(z, v) of stage i; the least pivot of the covariance behind it. */
static real mhe_correct_with_pivot(mhe_estimator *e, int i, real *out)
{
    mhe_correction(e, i, out);
    return mhe_least_pivot(mhe_next_covariance(e, i));
}

static const real *mhe_known_root(const mhe_estimator *e, int i)
{
    (void)e; (void)i;
    return 0;
}

static void mhe_forget_root(mhe_estimator *e, int i)
{
    (void)e; (void)i;
}
