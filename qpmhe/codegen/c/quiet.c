/* Directions without disturbances. */

/* Make next = predicted + keep (next - predicted) + shift; `shift` may be a null pointer. */
static void mhe_follow(const mhe_settings *s, const real *predicted, const real *keep,
                       const real *shift, real *next)
{
    real ahead[NX];
    for (int j = 0; j < NX; j++) ahead[j] = next[j] - predicted[j];
    mhe_wrap_state(s, next, ahead);
    for (int j = 0; j < NX; j++)
        next[j] = predicted[j] + mhe_dot(NX, keep + j * NX, ahead) + (shift ? shift[j] : 0);
}

/* A trial's next state, as the model and its disturbances make it; of the candidate along the directions
 * of the cost alone. */
static void mhe_follow_model(const mhe_settings *s, const real *predicted, int is_candidate,
                             real *next)
{
    if (is_candidate)
        mhe_follow(s, predicted, s->candidate_keep, 0, next);
    else
        mhe_follow(s, predicted, s->keep, s->shift, next);
}

/* The candidate's disturbances: its corrections, as far as they are in directions that have some. */
static const real *mhe_candidate_disturbances(const mhe_estimator *e, mhe_workspace *k)
{
    const real *w = k->trials->w;
    for (int i = 0; i < e->length; i++)
        mhe_times(NX, e->settings->candidate_keep, w + i * NX, k->bent.w + i * NX);
    return k->bent.w;
}

/* out = keep P keep', the covariance of disturbances as far as they are in these directions. */
static void mhe_keep_directions(const mhe_settings *s, real *P)
{
    real product[NX * NX];
    mhe_multiply(NX, NX, NX, s->candidate_keep, P, product);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++)
            P[i * NX + j] = mhe_dot(NX, product + i * NX, s->candidate_keep + j * NX);
}
