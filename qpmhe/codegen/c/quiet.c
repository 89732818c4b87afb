/* Directions without disturbances, and the candidate's roll-out where it has corrections in them.
 *
 * Of the settings: x(i+1) = f + keep (x(i+1) - f) + shift; of the candidate, with candidate_keep, along
 * the rows of `directions` alone. */

/* Make next = predicted + keep (next - predicted) + shift; `shift` may be a null pointer. */
static void mhe_follow(const mhe_settings *s, const real *predicted, const real *keep,
                       const real *shift, real *next)
{
    real ahead[NX];
    for (int j = 0; j < NX; j++) ahead[j] = next[j] - predicted[j];
    mhe_wrap_state(s, next, ahead);
    for (int j = 0; j < NX; j++)
        next[j] = predicted[j] + mhe_dot(NX, keep + j * NX, ahead) + (shift ? shift[j] : 0);
    (void)s; /* states without angles */
}

/* A trial's next state, as the model and its disturbances make it; of the candidate along the directions
 * of the cost alone. */
static void mhe_follow_model(const mhe_settings *s, const real *predicted, int is_candidate,
                             real *next)
{
    if (is_candidate)
        mhe_follow(s, predicted, s->quiet.candidate_keep, 0, next);
    else
        mhe_follow(s, predicted, s->quiet.keep, s->elimination.shift, next);
}

/* The candidate's disturbances: its corrections, as far as they are in directions that have some. */
static const real *mhe_candidate_disturbances(const mhe_estimator *e, mhe_workspace *k)
{
    const real *w = k->trials->w;
    for (int i = 0; i < e->length; i++)
        mhe_times(NX, e->settings->quiet.candidate_keep, w + i * NX, k->bent.w + i * NX);
    return k->bent.w;
}

/* out = keep P keep', the covariance of disturbances as far as they are in these directions. */
static void mhe_keep_directions(const mhe_settings *s, real *P)
{
    real product[NX * NX];
    mhe_multiply(NX, NX, NX, s->quiet.candidate_keep, P, product);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++)
            P[i * NX + j] = mhe_dot(NX, product + i * NX, s->quiet.candidate_keep + j * NX);
}

/* Whether the candidate has a correction in a direction without disturbances: it has no cost then,
 * and its J is that of its roll-out. */
static void mhe_roll_candidate_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    int is_quiet = 1;
    for (int i = 0; i < e->length; i++)
        for (int q = 0; q < MHE_QUIET; q++) {
            const real *direction = e->settings->quiet.directions + q * NX, *w = o->candidate->w + i * NX;
            real share = 0, size = 0;
            for (int j = 0; j < NX; j++) {
                share += direction[j] * w[j];
                size += fabs(direction[j] * w[j]);
            }
            if (!(fabs(share) <= MHE_IN_RANGE * size)) is_quiet = 0;
        }
    if (is_quiet || !isfinite(o->candidate->cost)) return;
    memcpy(o->spare->x, o->candidate->x, sizeof o->spare->x);
    mhe_judge(e, k, o->spare, 1);
    o->candidate->cost = o->spare->cost;
    if (!isfinite(o->candidate->cost)) o->events |= MHE_MODEL_FAILED;
    o->rolled_out = 1;
}

/* Search on from the trajectory of which the candidate's cost is, after a search in vain: no step
 * from the candidate itself need lower this cost, however short. */
static void mhe_search_from_rolled_out(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o)
{
    const int left = e->settings->max_qps - o->qps;
    if (!o->rolled_out || o->events & MHE_CANDIDATE_OUTSIDE || o->best != o->candidate) return;
    if (e->settings->max_qps == 0) return;
    memcpy(o->spare->x, o->candidate->x, sizeof o->spare->x);
    mhe_evaluate(e, k, o->spare);
    const real before = o->spare->cost;
    if (!isfinite(before) || left <= 0) return;
    mhe_take(k, o);
    o->events &= ~OUTDATED;
    mhe_search(e, k, o, -1, left);
    if (o->best->cost < before) return;
    o->spare = o->best;
    o->best = o->candidate;
}
