/* The cost of an offset from the prior. */

#define mhe_rooted_form(root, W, a) mhe_form(NX, W, a)

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
