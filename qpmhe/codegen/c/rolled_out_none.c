/* All directions have disturbances: the candidate is a trajectory of the model. */

static void mhe_roll_candidate_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    (void)e; (void)k; (void)o;
}

static void mhe_search_from_rolled_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    (void)e; (void)k; (void)o;
}
