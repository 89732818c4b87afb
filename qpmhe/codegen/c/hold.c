/* A term of J: parameters are held at their last trusted values where the window does not see them.
 * Of the settings: `deviations` are the units of the matrices on all states, `root` is that of the
 * prior's covariance, `spread` the covariance of the disturbances; `pick` leads from the columns of
 * `root` to held parameters, of which `components` are the states. */

@mhe_prior
    /* Of the present window: the weight of held parameters, and how their trusted values follow. */
    mhe_real held[MHE_HELD * MHE_HELD], follow[MHE_HELD * MHE_HELD];
@
/* What the data of the window say about its first state, in deviations of the prior. */
static void mhe_window_information(mhe_estimator *e, real *M)
{
    const mhe_hold *hold = &e->settings->hold;
    const real *unit = hold->deviations;
    real root[NX * NX], moved[NX * NX], later[NX * NX], inner[NX * NX], A[NX * NX];
    real C[NY * NX], weighted[NY * NX];
    for (int i = 0; i < NX * NX; i++) M[i] = 0;
    for (int i = e->length - 1; i >= 0; i--) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        for (int r = 0; r < NX; r++)
            for (int c = 0; c < NX; c++)
                A[r * NX + c] = stage->terms.f_jacobian[r * NX + c] * unit[c] / unit[r];
        for (int r = 0; r < NY; r++)
            for (int c = 0; c < NX; c++)
                C[r * NX + c] = stage->terms.h_jacobian[r * NX + c] * unit[c];
        mhe_through_disturbance(NX, M, hold->spread, root, moved, inner, later);
        for (int j = 0; j < NX * NX; j++) M[j] = 0;
        mhe_multiply(NX, NX, NX, later, A, moved);
        mhe_add_product(NX, NX, NX, A, moved, M);
        mhe_multiply(NY, NY, NX, stage->noise_weight, C, weighted);
        mhe_add_product(NY, NX, NX, C, weighted, M);
        mhe_symmetrise(NX, M);
    }
}

/* The share of the prior's variance of the held parameters that the window leaves. */
static void mhe_share_left(mhe_estimator *e, real *share)
{
    const mhe_hold *hold = &e->settings->hold;
    real M[NX * NX], product[NX * NX], left[NX * MHE_HELD];
    mhe_window_information(e, M);
    mhe_multiply(NX, NX, NX, M, hold->root, product);
    for (int i = 0; i < NX * NX; i++) M[i] = 0;
    mhe_add_product(NX, NX, NX, hold->root, product, M);
    for (int j = 0; j < NX; j++) M[j * NX + j] += 1;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < MHE_HELD; j++) left[i * MHE_HELD + j] = hold->pick[j * NX + i];
    if (mhe_decompose(NX, M))
        mhe_solve_for(NX, M, MHE_HELD, left);
    else
        left[0] = NAN;
    mhe_multiply(MHE_HELD, NX, MHE_HELD, hold->pick, left, share);
    mhe_symmetrise(MHE_HELD, share);
}

/* out = B' M B for square matrices. */
static void mhe_held_form(const real *B, const real *M, real *out)
{
    real product[MHE_HELD * MHE_HELD];
    mhe_multiply(MHE_HELD, MHE_HELD, MHE_HELD, M, B, product);
    for (int i = 0; i < MHE_HELD * MHE_HELD; i++) out[i] = 0;
    mhe_add_product(MHE_HELD, MHE_HELD, MHE_HELD, B, product, out);
}

/* Set the weight of held parameters, and how their trusted values follow the estimate. */
static void mhe_hold_begin(mhe_estimator *e, mhe_workspace *k)
{
    const mhe_hold *hold = &e->settings->hold;
    mhe_prior *prior = &k->prior;
    enum { COUNT = MHE_HELD * MHE_HELD };
    real share[COUNT], V[COUNT], values[COUNT], unseen[COUNT], held[COUNT], free_part[COUNT];
    memset(prior->held, 0, sizeof prior->held);
    memset(prior->follow, 0, sizeof prior->follow);
    if (e->settings->max_qps == 0) return; /* no Jacobians, and no other trajectory to choose */
    mhe_share_left(e, share);
    mhe_eigen(MHE_HELD, share, V);
    memset(values, 0, sizeof values);
    for (int j = 0; j < MHE_HELD; j++) {
        /* 1 / (1 + s), of which 1 / s is made; whatever is no number is not seen. */
        const real left = share[j * MHE_HELD + j];
        values[j * MHE_HELD + j] = left < (real)0.5 ? mhe_max(left, 0) / (1 - left) : 1;
        if (!isfinite(left))
            for (int i = 0; i < MHE_HELD; i++) V[j * MHE_HELD + i] = i == j;
    }
    mhe_held_form(V, values, unseen);
    mhe_multiply(MHE_HELD, MHE_HELD, MHE_HELD, unseen, unseen, held);
    for (int i = 0; i < MHE_HELD; i++)
        for (int j = 0; j < MHE_HELD; j++) {
            const int at = i * MHE_HELD + j;
            const real stiff = hold->stiffness[i] * hold->stiffness[j];
            free_part[at] = (i == j) - unseen[at];
            held[at] *= stiff;
            unseen[at] = stiff * unseen[at] + (i == j);
        }
    mhe_held_form(hold->inverse_units, held, prior->held);
    if (!mhe_decompose(MHE_HELD, unseen)) return;
    mhe_solve_for(MHE_HELD, unseen, MHE_HELD, free_part);
    mhe_multiply(MHE_HELD, MHE_HELD, MHE_HELD, free_part, hold->inverse_units, held);
    mhe_multiply(MHE_HELD, MHE_HELD, MHE_HELD, hold->units, held, prior->follow);
}

static void mhe_held_offset(const mhe_estimator *e, const real *x, real *offset)
{
    for (int j = 0; j < MHE_HELD; j++)
        offset[j] = x[e->settings->hold.components[j]] - e->trusted[j];
}

/* Let the next window's trusted values follow an estimate, or leave them. */
static void mhe_trust(mhe_estimator *e, const mhe_workspace *k, const real *trajectory)
{
    real offset[MHE_HELD], *following = e->trusted + MHE_HELD;
    memcpy(following, e->trusted, sizeof offset);
    if (!trajectory) return;
    mhe_held_offset(e, trajectory + (e->length == MHE_HORIZON) * NX, offset);
    for (int j = 0; j < MHE_HELD; j++)
        following[j] += mhe_dot(MHE_HELD, k->prior.follow + j * MHE_HELD, offset);
}

/* The values for the next window are those for this one now. */
static void mhe_trust_on(mhe_estimator *e)
{
    memcpy(e->trusted, e->trusted + MHE_HELD, sizeof e->trusted / 2);
}

static void mhe_trust_start(mhe_estimator *e)
{
    for (int j = 0; j < 2 * MHE_HELD; j++)
        e->trusted[j] = e->z_end[e->settings->hold.components[j % MHE_HELD]];
}

/* What the hold adds to J of a trial. */
static real mhe_hold_cost(const mhe_estimator *e, const mhe_workspace *k, const mhe_trial *trial)
{
    real offset[MHE_HELD];
    mhe_held_offset(e, trial->x, offset);
    return k->factors[0] * mhe_form(MHE_HELD, k->prior.held, offset);
}

/* Add it to the first state's matrix, by rows of this width, and to the gradient of the QP. */
static void mhe_hold_add(const mhe_estimator *e, mhe_workspace *k, real factor, real *matrix,
                         int width)
{
    const int32_t *at = e->settings->hold.components;
    real offset[MHE_HELD];
    mhe_held_offset(e, k->prior.first, offset);
    for (int r = 0; r < MHE_HELD; r++) {
        const real *row = k->prior.held + r * MHE_HELD;
        k->gradient[at[r]] += factor * mhe_dot(MHE_HELD, row, offset);
        for (int c = 0; c < MHE_HELD; c++)
            matrix[at[r] * width + at[c]] += factor * row[c];
    }
}
