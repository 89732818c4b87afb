/* The prior of a window: its mean, and its weight from the observer's covariance. */

#if MHE_OBSERVER_PRIOR
/* A variance below it counts as it, so that the weight and its square do not overflow. */
#define LEAST_VARIANCE (sizeof(real) == 8 ? (real)3.0549363634996047e-151 : (real)1e-24)

/* Correlations with eigenvalues above so many times the least are inverted without them. */
#define WELL_CONDITIONED 100

/* out = the sum of value_i v_i v_i' for the eigenvectors in the rows of V. */
static void mhe_compose(const real *values, const real *V, real *out)
{
    real scaled[NX * NX];
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            scaled[i * NX + j] = values[i] * V[i * NX + j];
            out[i * NX + j] = 0;
        }
    mhe_add_product(NX, NX, NX, V, scaled, out);
    mhe_symmetrise(NX, out);
}

/* out = the inverse of M, of which each eigenvalue counts as `least` at least. M is
 * overwritten. */
static void mhe_bounded_inverse(real *M, real least, int is_clear, real *out)
{
    real V[NX * NX], values[NX];
    if (is_clear && mhe_invert(NX, M, out)) return;
    mhe_eigen(NX, M, V);
    for (int i = 0; i < NX; i++) {
        const real value = M[i * NX + i];
        values[i] = 1 / (value > least ? value : least);
    }
    mhe_compose(values, V, out);
}

/* The weight of the prior from a covariance, which is overwritten. */
static void mhe_weight_of(const mhe_covariances *o, real *P, real *out)
{
    real scratch[NX * NX], deviations[NX];
    for (int j = 0; j < NX; j++) deviations[j] = sqrt(mhe_max(P[j * NX + j], LEAST_VARIANCE));
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) P[i * NX + j] /= deviations[i] * deviations[j];
    const int is_clear =
        mhe_eigenvalues_within(NX, P, WELL_CONDITIONED * o->least, INFINITY, scratch);
    mhe_bounded_inverse(P, o->least, is_clear, out);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) {
            real *entry = out + i * NX + j;
            *entry = *entry / (deviations[i] * deviations[j]) + o->least_weight[i * NX + j];
        }
}

/* The weight with the variances of some states increased. */
static void mhe_weight_plus(const mhe_covariances *o, const real *covariance, const real *plus,
                            real factor, real *out)
{
    real P[NX * NX];
    memcpy(P, covariance, sizeof P);
    for (int j = 0; j < NX; j++) P[j * NX + j] += factor * plus[j];
    mhe_weight_of(o, P, out);
}
#endif

#if MHE_PRIOR_ROOTS
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
static int mhe_root_is_better(const mhe_covariances *o, const real *root, const real *later)
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
    return MHE_ROLLED ? pivot > singular : pivot * o->least * shrunk * shrunk > EPSILON;
}
#endif

/* The prior of the present window, before the candidate's cost is known. */
static void mhe_set_prior(mhe_estimator *e, mhe_workspace *k)
{
    const mhe_stage *first = mhe_stage_at(e, 0);
    mhe_prior *prior = &k->prior;
    prior->mean = first->z;
    prior->weight = prior->distance_weight = e->settings->prior_weight;
#if MHE_OBSERVER_PRIOR
    const mhe_covariances *o = &e->settings->covariances;
    real known[NX], covariance[NX * NX];
    int count = 0;
    for (int j = 0; j < NX * NX; j++) covariance[j] = first->covariance[j] + o->added[j];
    for (int j = 0; j < NX; j++) {
        const int is_known =
            o->typical[j] > 0 && covariance[j * NX + j] <= MHE_NO_VARIANCE * o->typical[j];
        known[j] = is_known ? o->typical[j] : 0;
        count += is_known;
    }
    prior->weight = prior->distance_weight = prior->own_weight;
    /* A state that is known exactly is judged by its typical magnitude. */
    if (count) prior->distance_weight = prior->own_distance;
#if MHE_PRIOR_ROOTS
    prior->root = prior->distance_root = 0;
    if (MHE_ROLLED || first->is_vague) {
        real wider[NX * NX], own_root[NX * NX];
        const real *root = first->root;
        if (!first->is_vague) {
            mhe_root(NX, first->covariance, own_root);
            root = own_root;
        }
        mhe_widen_root(o, root, known, MHE_KNOWN, wider);
        if (mhe_root_is_better(o, wider, mhe_next_covariance(e, e->length - 1))) {
            prior->root = prior->distance_root = prior->own_root;
            mhe_weight_from_root(o, wider, prior->own_weight, prior->own_root);
            if (!count) return;
            prior->distance_root = prior->own_distance_root;
            mhe_widen_root(o, root, known, 1, wider);
            mhe_weight_from_root(o, wider, prior->own_distance, prior->own_distance_root);
            return;
        }
    }
#endif
    mhe_weight_plus(o, covariance, known, MHE_KNOWN, prior->own_weight);
    if (count) mhe_weight_plus(o, covariance, known, 1, prior->own_distance);
#endif
}

/* Take the smoothed prior in place of the observer's state, unless the candidate has no finite
 * cost about it; by how much the candidate's cost rises. */
static real mhe_move_prior(mhe_estimator *e, mhe_workspace *k)
{
    real offset[NX];
    if (!e->has_smoothed) return 0;
    for (int j = 0; j < NX; j++) offset[j] = mhe_stage_at(e, 0)->z[j] - e->smoothed_prior[j];
    mhe_wrap_state(e->settings, mhe_stage_at(e, 0)->z, offset);
    const real cost = mhe_prior_cost(e->settings, k, offset);
    if (!isfinite(cost)) return 0;
    k->prior.mean = e->smoothed_prior;
    return k->factors[0] * cost;
}
