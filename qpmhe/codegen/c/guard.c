/* The guard: estimates of the last state within the set that is proved to hold the true one, the states
 * of K with |x - z|_P <= radius and |x_j - z_j| <= box[j]. An output map: nothing feeds back. */

/* As qpmhe.certificates.guard has it, in the same order. Halvings of the way from z to an estimate; and
 * from how many radii on only the direction of an estimate counts. */
#define HALVINGS 64
#define FAR ((real)1e6)
#define OUTWARD (1 + 16 * EPSILON)

#define GUARD_SAMPLES $samples /* of the bounds: the last ones hold from there on */
#define GUARD_KINDS $kinds /* of the bounds: those behind a projection as well, or not */

static const real mhe_guard_metric[NX * NX] = {$metric};       /* P */
static const real mhe_guard_covariance[NX * NX] = {$covariance}; /* its inverse */
static const real mhe_guard_gain[NX * NY] = {$gain};
/* The region of the proof, states and then inputs, and the rows of K. */
static const real mhe_guard_lower[NX + NU] = {$lower};
static const real mhe_guard_upper[NX + NU] = {$upper};
static const mhe_guard_set mhe_guard_states = {$states};
static const mhe_guard_set mhe_guard_region = {$region};
/* Bounds on |x - z|_P and |x_j - z_j|: before the observer was projected, and from then on. */
static const real mhe_guard_radius[GUARD_KINDS][GUARD_SAMPLES] = {$radius};
static const real mhe_guard_box[GUARD_KINDS][GUARD_SAMPLES][NX] = {$box};

typedef struct {
    real radius, box[NX];
} mhe_tube;

static void mhe_tube_at(const mhe_guard *g, int64_t time, mhe_tube *tube)
{
    const int k = time < GUARD_SAMPLES ? (int)time : GUARD_SAMPLES - 1;
    const int kind = GUARD_KINDS > 1 && g->projected;
    tube->radius = mhe_guard_radius[kind][k];
    for (int j = 0; j < NX; j++) tube->box[j] = mhe_guard_box[kind][k][j];
}

/* |s|_P, rounded up. */
static real mhe_guard_length(const real *s, const real *P)
{
    real square = 0, slack = 0;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            square += s[i] * P[i * NX + j] * s[j];
            slack += fabs(s[i] * P[i * NX + j] * s[j]);
        }
    return sqrt(mhe_max(square, 0) + (2 * NX + 4) * EPSILON * slack) * OUTWARD;
}

/* Whether a point is in ball and box, with distances rounded up; not where one is NaN. */
static int mhe_guard_holds(const real *point, const real *z, const mhe_tube *tube)
{
    real offset[NX], rounding[NX], sizes[NX * NX];
    for (int i = 0; i < NX * NX; i++) sizes[i] = fabs(mhe_guard_metric[i]);
    for (int j = 0; j < NX; j++) {
        offset[j] = point[j] - z[j];
        rounding[j] = EPSILON * fabs(offset[j]);
        if (!((fabs(offset[j]) + rounding[j]) * OUTWARD <= tube->box[j])) return 0;
    }
    const real length = mhe_guard_length(offset, mhe_guard_metric) + mhe_guard_length(rounding, sizes);
    return length * OUTWARD <= tube->radius;
}

/* The projection of a point between an estimate and z, if it is in the set. */
static int mhe_guard_between(const mhe_guard_set *near, const mhe_guard_spread *P, const real *x,
                             const real *z, real share, const mhe_tube *tube, real *out)
{
    real target[NX], found[NX];
    for (int j = 0; j < NX; j++) target[j] = share >= 1 ? x[j] : share > 0 ? z[j] + share * (x[j] - z[j]) : z[j];
    memcpy(found, target, sizeof found);
    if (!mhe_guard_is_inside(near, target)) mhe_guard_project(near, P, target, found);
    if (!mhe_guard_holds(found, z, tube) || !mhe_guard_is_inside(&mhe_guard_states, found)) return 0;
    memcpy(out, found, sizeof found);
    return 1;
}

/* out = the estimate itself if it is in the set, else the nearest point that is; 1 where it was moved,
 * -1 where no point was found. */
static int mhe_guard_move(const real *estimate, const real *z, const mhe_tube *tube, real *out)
{
    real x[NX], largest = 0;
    mhe_guard_set near = mhe_guard_states;
    mhe_guard_spread P;
    memcpy(x, estimate, sizeof x);
    memcpy(out, x, sizeof x);
    if (mhe_guard_holds(x, z, tube) && mhe_guard_is_inside(&mhe_guard_states, x)) return 0;
    for (int j = 0; j < NX; j++) {
        /* A little narrower, so that points on its sides are in the box in spite of rounding. */
        const real half =
            mhe_max((1 - 64 * EPSILON) * tube->box[j] - 4 * EPSILON * fabs(z[j]), 0);
        near.lower[j] = mhe_max(near.lower[j], z[j] - half);
        if (z[j] + half < near.upper[j]) near.upper[j] = z[j] + half;
        if (!(near.lower[j] <= near.upper[j])) return -1;
    }
    mhe_guard_set_metric(&P, mhe_guard_covariance, 0);
    for (int j = 0; j < NX; j++) out[j] = x[j] - z[j], largest = mhe_max(fabs(out[j]), largest);
    for (int j = 0; j < NX; j++) out[j] /= largest;
    const real far = FAR * tube->radius / largest / mhe_guard_length(out, mhe_guard_metric);
    for (int j = 0; j < NX && far < 1; j++) x[j] = z[j] + far * (x[j] - z[j]);
    /* The largest share of the way from z of which the projection is in the set. */
    if (mhe_guard_between(&near, &P, x, z, 1, tube, out)) return 1;
    if (!mhe_guard_between(&near, &P, x, z, 0, tube, out)) return -1;
    real low = 0, high = 1;
    for (int i = 0; i < HALVINGS; i++) {
        const real middle = (real)0.5 * (low + high);
        if (mhe_guard_between(&near, &P, x, z, middle, tube, out)) low = middle;
        else high = middle;
    }
    return 1;
}

/* Why the bound does not follow at the newest sample; 0 where it does. */
static int mhe_guard_ends(const mhe_guard *g, const mhe_estimator *e, const mhe_estimate *estimate)
{
    const int ends = MHE_MODEL_FAILED | MHE_METRIC_SINGULAR | MHE_RESTARTED;
    const mhe_settings *s = e->settings, *own = &mhe_default_settings;
    const int keeps = $projects && s->project == own->project && !memcmp(s->metric, own->metric, sizeof s->metric);
    const mhe_stage *stage = e->stages + (e->first + e->length - 1) % MHE_HORIZON;
    if (e->time != g->time + 1 || estimate->time != g->time || e->length < 1)
        return MHE_GUARD_OTHER_SAMPLE;
    if (estimate->status & ends || !stage->is_complete) return MHE_GUARD_EVENT;
    if (estimate->status & MHE_OBSERVER_PROJECTED && !keeps) return MHE_GUARD_EVENT;
    for (int j = 0; j < NX; j++)
        if (stage->z[j] != g->observer_state[j]) return MHE_GUARD_OTHER_OBSERVER;
    if (!(stage->u[NU] == s->sample_time)) return MHE_GUARD_EVENT;
    for (int j = 0; j < NU; j++)
        if (!(mhe_guard_lower[NX + j] <= stage->u[j] && stage->u[j] <= mhe_guard_upper[NX + j]))
            return MHE_GUARD_OUTSIDE;
    if (!mhe_guard_is_within(&mhe_guard_region, stage->z)) return MHE_GUARD_OUTSIDE;
    for (int j = 0; j < NX && !(estimate->status & MHE_OBSERVER_PROJECTED); j++) {
        real size = 0;
        for (int q = 0; q < NY; q++) size += fabs(mhe_guard_gain[j * NY + q] * stage->v[q]);
        const real correction = mhe_dot(NY, mhe_guard_gain + j * NY, stage->v);
        if (!(fabs(stage->w[j] - correction) <= (real)1e-9 * size)) return MHE_GUARD_OTHER_OBSERVER;
    }
    return 0;
}

void mhe_guard_start(mhe_guard *g, const mhe_estimator *e)
{
    memset(g, 0, sizeof *g);
    memcpy(g->observer_state, e->z_end, sizeof g->observer_state);
    memcpy(g->state, e->z_end, sizeof g->state);
    memcpy(g->filtered, e->z_end, sizeof g->filtered);
    if (e->time) g->off = MHE_GUARD_OTHER_SAMPLE;
    for (int j = 0; j < NX; j++) g->error[j] = g->off ? NAN : mhe_guard_box[0][0][j];
}

void mhe_guard_check(mhe_guard *g, const mhe_estimator *e, const mhe_estimate *estimate)
{
    const real *x = estimate->trajectory + estimate->length * NX;
    real before[NX];
    mhe_tube first, last;
    g->moved = 0;
    if (!g->off) g->off = mhe_guard_ends(g, e, estimate);
    memcpy(before, g->observer_state, sizeof before);
    memcpy(g->observer_state, e->z_end, sizeof g->observer_state);
    mhe_tube_at(g, g->time, &first);
    g->time++;
    g->projected |= (estimate->status & MHE_OBSERVER_PROJECTED) != 0;
    mhe_tube_at(g, g->time, &last);
    if (!g->off) {
        const int later = mhe_guard_move(x, e->z_end, &last, g->state);
        const int now = mhe_guard_move(estimate->filtered, before, &first, g->filtered);
        if (later < 0 || now < 0) g->off = MHE_GUARD_EMPTY;
        else g->moved = (later ? MHE_GUARD_STATE : 0) | (now ? MHE_GUARD_FILTERED : 0);
    }
    if (g->off) {
        memcpy(g->state, x, sizeof g->state);
        memcpy(g->filtered, estimate->filtered, sizeof g->filtered);
    }
    for (int j = 0; j < NX; j++)
        g->error[j] = g->off ? NAN : (fabs(g->state[j] - e->z_end[j]) + last.box[j]) * OUTWARD;
}
