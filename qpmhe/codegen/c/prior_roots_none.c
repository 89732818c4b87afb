/* The prior's weight has no root. */

/* The squared distance of an offset from the prior. */
static real mhe_prior_distance(const mhe_prior *prior, const real *offset)
{
    return mhe_form(NX, prior->distance_weight, offset);
}

/* out = W a for the prior's weight. */
static void mhe_prior_force(const mhe_prior *prior, const real *a, real *out)
{
    mhe_times(NX, prior->weight, a, out);
}

/* Gamma of an offset from the prior; quadratic where the observer weighs it. */
static real mhe_prior_cost(const mhe_settings *s, const mhe_workspace *k, const real *offset)
{
    return mhe_lost(&s->prior_loss, 1, NX, k->prior.weight, offset);
}

/* The root of the prior's weight, where it has one. */
static const real *mhe_root_of_prior(const mhe_prior *prior)
{
    (void)prior;
    return 0;
}

static void mhe_join_prior_root(const real *root, real factor, real *prior_root)
{
    (void)root; (void)factor; (void)prior_root;
}

static int mhe_weigh_prior_by_root(mhe_estimator *e, mhe_prior *prior, const real *covariance,
                                   const real *known, int count)
{
    (void)e; (void)prior; (void)covariance; (void)known; (void)count;
    return 0;
}
