/* Steps of QPs without inequalities: where one does not lower the cost, shorter ones along Powell's
 * dogleg, in a region that follows from how the cost fell before.
 *
 * Lengths are those of the damping, with the largest D of the sequence so far. */

@mhe_workspace
    mhe_real descent[(MHE_HORIZON + 1) * MHE_NX]; /* steepest, in the metric of the region */
    mhe_real largest[MHE_NX];         /* D of the region */
@

/* No region, at the beginning of a sequence and after a damped step. */
static void mhe_forget_region(mhe_workspace *k, mhe_outcome *o)
{
    o->radius = INFINITY;
    for (int j = 0; j < NX; j++) k->largest[j] = 0;
}

/* Set D of the region, about the QP's trajectory. */
static void mhe_set_largest(mhe_estimator *e, mhe_workspace *k)
{
    mhe_set_seen(e, k);
    for (int j = 0; j < NX; j++)
        k->largest[j] = mhe_max(k->largest[j], mhe_first_diagonal(k, j) + k->seen[j]);
}

/* The square of what a step adds to the cost's linear part of stage i: in its disturbance, or with
 * `all` in its outputs, too. */
static real mhe_stage_square(mhe_estimator *e, mhe_workspace *k, int i, const real *step, int all)
{
    const mhe_stage *stage = mhe_stage_at(e, i);
    const mhe_terms *t = k->at[i];
    const real *Q = mhe_disturbance_weight(e->settings, stage), *R = stage->noise_weight;
    const real *own = step + i * NX;
    real moved[NX], seen[NY], sum = 0;
    for (int j = 0; j < NX; j++) moved[j] = own[NX + j] - mhe_dot(NX, t->f_jacobian + j * NX, own);
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++)
            sum += moved[r] * mhe_scaled(Q[r * NX + c], t->disturbance_scale, r) * moved[c];
    for (int j = 0; all && j < NY; j++) seen[j] = mhe_dot(NX, t->h_jacobian + j * NX, own);
    for (int r = 0; all && r < NY; r++)
        for (int c = 0; c < NY; c++)
            sum += seen[r] * mhe_scaled(R[r * NY + c], t->noise_scale, r) * seen[c];
    return k->factors[i + 1] * sum;
}

/* The length of the QP's step. */
static real mhe_length_of_step(mhe_estimator *e, mhe_workspace *k)
{
    real square = 0;
    for (int j = 0; j < NX; j++) square += k->largest[j] * k->step[j] * k->step[j];
    for (int i = 0; i < e->length; i++) square += mhe_stage_square(e, k, i, k->step, 0);
    return sqrt(square);
}

/* Set the direction of steepest descent; its curvature. */
static real mhe_set_descent(mhe_estimator *e, mhe_workspace *k)
{
    const int count = e->length;
    real *d = k->descent, spread[NX * NX], moved[NX], force[NX];
    memcpy(d, k->gradient, sizeof(real) * (size_t)(count + 1) * NX);
    for (int i = count - 1; i >= 0; i--)
        mhe_add_product(NX, NX, 1, k->at[i]->f_jacobian, d + (i + 1) * NX, d + i * NX);
    for (int j = 0; j < NX; j++) d[j] = -d[j] / k->largest[j];
    real curvature = mhe_first_form(k, d);
    for (int i = 0; i < count; i++) {
        mhe_disturbance_covariance(e, k, i, spread);
        mhe_times(NX, spread, d + (i + 1) * NX, force);
        mhe_times(NX, k->at[i]->f_jacobian, d + i * NX, moved);
        for (int j = 0; j < NX; j++) d[(i + 1) * NX + j] = moved[j] - force[j];
        curvature += mhe_stage_square(e, k, i, d, 1);
    }
    return curvature;
}

/* The dogleg: its Cauchy point is `far` along the descent, its end is the QP's step. */
typedef struct {
    real length, promised, slope, curvature, far;
} mhe_dogleg;

static void mhe_set_dogleg(mhe_estimator *e, mhe_workspace *k, real promised, mhe_dogleg *path)
{
    mhe_set_largest(e, k);
    path->length = mhe_length_of_step(e, k);
    path->promised = promised;
    path->curvature = mhe_set_descent(e, k);
    path->slope = -mhe_dot((e->length + 1) * NX, k->gradient, k->descent);
    path->far = path->curvature > 0 ? path->slope / path->curvature : NAN;
}

/* Make the spare trial the step at the radius, unless what it promises is rounding; whether it is. */
static int mhe_try_part(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, const mhe_dogleg *path)
{
    const real radius = o->radius, slope = path->slope, far = path->far, end = path->promised;
    real along = 0, share = 0;
    if (!(far * slope > 0 && isfinite(far * slope))) /* a part of the QP's step */
        share = radius / path->length;
    else if (far * sqrt(slope) >= radius)
        along = radius / sqrt(slope);
    else {
        /* |c + s (d - c)| = radius, c the Cauchy point. */
        const real square = far * far * slope, across = far * end;
        const real gap = mhe_max(path->length * path->length - 2 * across + square, 0);
        const real half = across - square, left = radius * radius - square;
        const real root = sqrt(mhe_max(half * half + gap * left, 0));
        share = half + root > 0 ? left / (half + root) : 1;
        if (share > 1) share = 1;
        along = (1 - share) * far;
    }
    real promised = 2 * (along * slope + share * end) - share * share * end;
    if (along > 0) promised -= along * (along * path->curvature + 2 * share * slope);
    o->tried = radius;
    o->expected = promised;
    o->is_shortened = 1;
    if (!(promised > MHE_ROUNDING * mhe_best_cost(o))) return 0;
    for (int j = 0; j < (e->length + 1) * NX; j++) {
        real step = share * k->step[j];
        if (along > 0) step += along * k->descent[j];
        o->spare->x[j] = o->best->x[j] + step;
    }
    mhe_clip_trial(e, k, o->spare);
    mhe_evaluate(e, k, o->spare);
    return 1;
}

/* Make the spare trial the first one whose cost is below the best so far, or the last one: the full
 * step where it is in the region, then shorter ones. A useless step, whose promised decrease is
 * negligible, is not shortened: at a minimum none lowers the cost by more than rounding. Nor is a damped
 * one. */
static void mhe_lower(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real promised, int useless)
{
    const real target = mhe_target(o);
    mhe_dogleg path;
    int is_set = 0;
    o->is_shortened = 0;
    if (useless || o->present > 0) {
        mhe_try(e, k, o, 1);
        return;
    }
    if (isfinite(o->radius)) {
        mhe_set_dogleg(e, k, promised, &path);
        is_set = 1;
    }
    if (!is_set || !(path.length > o->radius)) {
        o->expected = promised;
        o->tried = is_set ? path.length : 0;
        mhe_try(e, k, o, 1);
        if (o->spare->cost < target) return;
        if (!is_set) mhe_set_dogleg(e, k, promised, &path);
        o->radius = MHE_SMALLER_REGION * path.length;
    }
    for (int i = 0; i < MHE_SHORTER; i++) {
        if (!mhe_try_part(e, k, o, &path)) return;
        if (o->spare->cost < target) return;
        o->radius *= MHE_SMALLER_REGION;
    }
}

/* Let the region follow from a step that has lowered the cost by so much. Without a radius, a step that
 * does about as promised asks for none. */
static void mhe_follow_region(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real lowered)
{
    const real promised = o->expected;
    if (!isfinite(o->radius)) {
        if (lowered >= MHE_POOR * promised && lowered <= promised / MHE_POOR) return;
        mhe_set_largest(e, k);
        o->tried = mhe_length_of_step(e, k);
    }
    const real larger = MHE_LARGER_REGION * o->tried;
    if (promised > 0 && lowered / promised < MHE_POOR)
        o->radius = o->tried < o->radius ? o->tried : o->radius;
    else if (!(promised > 0) || lowered / promised > MHE_WELL)
        o->radius = isfinite(o->radius) ? mhe_max(o->radius, larger) : larger;
    else if (!isfinite(o->radius))
        o->radius = o->tried;
}
