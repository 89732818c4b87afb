/* All directions have disturbances: the candidate is a trajectory of the model. */

static void mhe_follow_model(const mhe_settings *s, const real *predicted, int is_candidate,
                             real *next)
{
    (void)s; (void)predicted; (void)is_candidate; (void)next;
}

static const real *mhe_candidate_disturbances(const mhe_estimator *e, mhe_workspace *k)
{
    (void)e;
    return k->trials->w;
}

static void mhe_keep_directions(const mhe_settings *s, real *P)
{
    (void)s; (void)P;
}

static void mhe_roll_candidate_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    (void)e; (void)k; (void)o;
}

static void mhe_search_from_rolled_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    (void)e; (void)k; (void)o;
}
