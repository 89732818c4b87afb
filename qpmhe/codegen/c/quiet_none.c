/* All directions have disturbances. */

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
