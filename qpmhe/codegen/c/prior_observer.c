/* The prior's weight from the observer's covariance. */

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

/* The prior's weight, from the covariance at the window's first state. */
static void mhe_weigh_prior(mhe_estimator *e, mhe_workspace *k)
{
    const mhe_covariances *o = &e->settings->covariances;
    const mhe_stage *first = mhe_stage_at(e, 0);
    mhe_prior *prior = &k->prior;
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
    if (mhe_weigh_prior_by_root(e, prior, covariance, known, count)) return;
    mhe_weight_plus(o, covariance, known, MHE_KNOWN, prior->own_weight);
    if (count) mhe_weight_plus(o, covariance, known, 1, prior->own_distance);
}
