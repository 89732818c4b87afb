/* The prior's weight from a root of the observer's covariance, and its cost by one where it has one. */

@mhe_prior
    /* R with R'R the weights, where R alone has all digits; else none. */
    const mhe_real *root, *distance_root;
    mhe_real own_root[MHE_NX * MHE_NX], own_distance_root[MHE_NX * MHE_NX];
@
/* a' W a; |R a|^2 where W has a root R: no digits cancel then. */
static real mhe_rooted_form(const real *root, const real *W, const real *a)
{
    real seen[NX];
    if (!root) return mhe_form(NX, W, a);
    mhe_times(NX, root, a, seen);
    return mhe_dot(NX, seen, seen);
}

/* The squared distance of an offset from the prior. */
static real mhe_prior_distance(const mhe_prior *prior, const real *offset)
{
    return mhe_rooted_form(prior->distance_root, prior->distance_weight, offset);
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

/* Join a root of the prior's weight, times a factor, to that of what is added to it. */
static void mhe_join_prior_root(const real *root, real factor, real *prior_root)
{
    real scaled[NX * NX], joined[NX * NX];
    for (int j = 0; j < NX * NX; j++) scaled[j] = sqrt(factor) * root[j];
    mhe_join_roots(scaled, prior_root, joined);
    memcpy(prior_root, joined, sizeof joined);
}

/* out = U'^-1 for an upper triangular U. */
static void mhe_invert_root(const real *U, real *out)
{
    for (int i = 0; i < NX; i++)
        for (int c = 0; c < NX; c++) {
            real sum = i == c;
            for (int l = c; l < i; l++) sum -= U[l * NX + i] * out[l * NX + c];
            out[i * NX + c] = c > i ? 0 : sum / U[i * NX + i];
        }
}

/* out = a root of the covariance with the variances of some states increased. */
static void mhe_widen_root(const mhe_covariances *o, const real *root, const real *plus,
                           real factor, real *out)
{
    real added[NX * NX], other[NX * NX];
    memcpy(added, o->added, sizeof added);
    for (int j = 0; j < NX; j++) added[j * NX + j] += factor * plus[j];
    mhe_root(NX, added, other);
    mhe_join_roots(root, other, out);
}

/* The weight and a root of it, from a root of the covariance. */
static void mhe_weight_from_root(const mhe_covariances *o, const real *covariance_root, real *out,
                                 real *root)
{
    real inverse[NX * NX], least[NX * NX];
    mhe_invert_root(covariance_root, inverse);
    mhe_root(NX, o->least_weight, least);
    mhe_join_roots(inverse, least, root);
    mhe_square(root, out);
}

/* Whether the weight loses fewer digits by a root of the covariance than by its inverse: always, where
 * elimination.c takes the root as it is. Where the QP takes its square: with r the least
 * variance of a component given those before it, as a share of its variance, and d the largest factor
 * by which the window's data reduce a variance, rounding of the weight has a share of eps / (r d) in a
 * variance behind the window, and the least eigenvalue l of an inverse one of l d. */
static int mhe_root_is_better(const mhe_covariances *o, const real *root, const real *later,
                              int takes_rows)
{
    real pivot = 1, shrunk = 0;
    for (int j = 0; j < NX; j++) {
        real own = 0;
        for (int i = 0; i <= j; i++) own += root[i * NX + j] * root[i * NX + j];
        const real share = root[j * NX + j] * root[j * NX + j] / own;
        const real behind = later[j * NX + j];
        if (!(share >= pivot)) pivot = share;
        if (behind > 0) shrunk = mhe_max(own / behind, shrunk);
    }
    /* A root of a singular covariance has only rounding in a direction. */
    const real singular = sizeof(real) == 8 ? (real)1e-26 : (real)1e-10;
    return takes_rows ? pivot > singular : pivot * o->least * shrunk * shrunk > EPSILON;
}

/* The prior's weight by a root of the covariance, where that is better; `count`: states that are
 * known exactly, with these variances. */
static int mhe_weigh_prior_by_root(mhe_estimator *e, mhe_prior *prior, const real *covariance,
                                   const real *known, int count)
{
    const mhe_covariances *o = &e->settings->covariances;
    const mhe_stage *first = mhe_stage_at(e, 0);
    real wider[NX * NX], own_root[NX * NX];
    const real *root = first->root;
    prior->root = prior->distance_root = 0;
    if (!MHE_ROLLED && !first->is_vague) return 0;
    if (!first->is_vague) {
        mhe_root(NX, first->covariance, own_root);
        root = own_root;
    }
    mhe_widen_root(o, root, known, MHE_KNOWN, wider);
    const real *later = mhe_next_covariance(e, e->length - 1);
    if (!mhe_root_is_better(o, wider, later, MHE_ROLLED)) return 0;
    const int is_sure = first->is_vague && mhe_root_is_better(o, wider, later, 0);
    prior->root = prior->distance_root = prior->own_root;
    mhe_weight_from_root(o, wider, prior->own_weight, prior->own_root);
    if (!is_sure) {
        /* In a direction of hardly any variance, rounding is no distance. */
        prior->distance_root = 0;
        prior->distance_weight = prior->own_distance;
        mhe_weight_plus(o, covariance, known, 1, prior->own_distance);
        return 1;
    }
    if (!count) return 1;
    prior->distance_root = prior->own_distance_root;
    mhe_widen_root(o, root, known, 1, wider);
    mhe_weight_from_root(o, wider, prior->own_distance, prior->own_distance_root);
    return 1;
}
