/* Elimination where the prior's weight has no root. */

static void mhe_join_prior_root(mhe_workspace *k, const real *root, real factor)
{
    (void)k; (void)root; (void)factor;
}
