/* Elimination where the prior's weight may have a root. */

/* Join a root of the prior's weight to that of what is added to it. */
static void mhe_join_prior_root(mhe_workspace *k, const real *root, real factor)
{
    real scaled[NX * NX], joined[NX * NX];
    for (int j = 0; j < NX * NX; j++) scaled[j] = sqrt(factor) * root[j];
    mhe_join_roots(scaled, k->prior_root, joined);
    memcpy(k->prior_root, joined, sizeof joined);
}
