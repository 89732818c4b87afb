/* A covariance that has lost digits is computed again by roots. */

/* L(z, v) of stage i; the least pivot of the covariance behind it. */
static real mhe_correct_with_pivot(mhe_estimator *e, int i, real *out)
{
    mhe_stage *stage = mhe_stage_at(e, i);
    const real *following = mhe_next_covariance(e, i);
    int has_root = mhe_correction(e, i, out);
    real found = mhe_least_pivot(following);
    if (found < MHE_VAGUE && !has_root) {
        mhe_root(NX, stage->covariance, stage->root);
        stage->is_vague = 1;
        has_root = mhe_correction(e, i, out);
        found = mhe_least_pivot(following);
    }
    *mhe_next_is_vague(e, i) = has_root && found >= 0 && found < MHE_VAGUE;
    return found;
}

/* The root of the covariance behind stage i, where the observer has one. */
static const real *mhe_known_root(mhe_estimator *e, int i)
{
    return *mhe_next_is_vague(e, i) ? mhe_next_root(e, i) : 0;
}

/* The covariance behind stage i comes from elsewhere, and has no root. */
static void mhe_forget_root(mhe_estimator *e, int i) { *mhe_next_is_vague(e, i) = 0; }
