/* The cost of an offset from the prior, by a root of its weight where there is one. */

/* a' W a; |R a|^2 where W has a root R: no digits cancel then. */
static real mhe_rooted_form(const real *root, const real *W, const real *a)
{
    real seen[NX];
    if (!root) return mhe_form(NX, W, a);
    mhe_times(NX, root, a, seen);
    return mhe_dot(NX, seen, seen);
}

/* out = W a for the prior's weight. */
static void mhe_prior_force(const mhe_prior *prior, const real *a, real *out)
{
    if (prior->root) {
        real seen[NX];
        mhe_times(NX, prior->root, a, seen);
        for (int j = 0; j < NX; j++) out[j] = 0;
        mhe_add_product(NX, NX, 1, prior->root, seen, out);
        return;
    }
    mhe_times(NX, prior->weight, a, out);
}

/* Gamma of an offset from the prior; quadratic where the observer weighs it. */
static real mhe_prior_cost(const mhe_settings *s, const mhe_workspace *k, const real *offset)
{
    if (k->prior.root) return mhe_rooted_form(k->prior.root, k->prior.weight, offset);
    return mhe_lost(&s->prior_loss, 1, NX, k->prior.weight, offset);
}

/* The root of the prior's weight, where it has one. */
static const real *mhe_root_of_prior(const mhe_prior *prior) { return prior->root; }
