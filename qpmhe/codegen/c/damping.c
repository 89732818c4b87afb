/* The scale of the damping that a QP gets where no step has lowered J.
 *
 * The QP's objective is half of J; damping adds half of
 *
 *     mu (|d(0)|_D^2 + sum |d(i+1) - A d(i)|_Q^2)
 *
 * to it. D is the diagonal of what prior and data say about d(0) where the disturbances are free. */

/* Covariance of the disturbances of stage i, for the weights along the trajectory of the QP. */
static void mhe_disturbance_covariance(mhe_estimator *e, const mhe_workspace *k, int i, real *spread)
{
    enum { COUNT = MHE_FREE };
    const mhe_settings *s = e->settings;
    const real *Q = mhe_disturbance_weight(s, mhe_stage_at(e, i));
    const real next = k->factors[i + 1];
    real scaled[NX * NX], F[SIZE(NX * COUNT)], product[SIZE(NX * COUNT)];
    real weight[SIZE(COUNT * COUNT)], across[SIZE(COUNT * NX)];
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < NX; c++)
            scaled[r * NX + c] = next * mhe_scaled(Q[r * NX + c], k->at[i]->disturbance_scale, r);
    for (int r = 0; r < NX; r++)
        for (int c = 0; c < COUNT; c++) {
            F[r * COUNT + c] = mhe_free_direction(s, r, c);
            across[c * NX + r] = F[r * COUNT + c];
        }
    for (int j = 0; j < COUNT * COUNT; j++) weight[j] = 0;
    mhe_multiply(NX, NX, COUNT, scaled, F, product);
    mhe_add_product(NX, COUNT, COUNT, F, product, weight);
    if (mhe_decompose(COUNT, weight))
        mhe_solve_for(COUNT, weight, NX, across);
    else
        across[0] = NAN;
    mhe_multiply(NX, COUNT, NX, F, across, spread);
}

/* Set what the data say about each component of the first state where the disturbances are free: with
 * the prior's weight, the scale of its damping. 0 where that is not finite. */
static void mhe_set_seen(mhe_estimator *e, mhe_workspace *k)
{
    real root[NX * NX], moved[NX * NX], later[NX * NX], inner[NX * NX], spread[NX * NX], M[NX * NX];
    real weighted[NY * NX], R[NY * NY];
    for (int j = 0; j < NX * NX; j++) M[j] = 0;
    for (int i = e->length - 1; i >= 0; i--) {
        const mhe_stage *stage = mhe_stage_at(e, i);
        const real *A = k->at[i]->f_jacobian, *C = k->at[i]->h_jacobian;
        const real next = k->factors[i + 1];
        mhe_disturbance_covariance(e, k, i, spread);
        mhe_through_disturbance(NX, M, spread, root, moved, inner, later);
        for (int j = 0; j < NX * NX; j++) M[j] = 0;
        mhe_multiply(NX, NX, NX, later, A, moved);
        mhe_add_product(NX, NX, NX, A, moved, M);
        for (int r = 0; r < NY; r++)
            for (int c = 0; c < NY; c++)
                R[r * NY + c] =
                    next * mhe_scaled(stage->noise_weight[r * NY + c], k->at[i]->noise_scale, r);
        mhe_multiply(NY, NY, NX, R, C, weighted);
        mhe_add_product(NY, NX, NX, C, weighted, M);
        mhe_symmetrise(NX, M);
    }
    real sum = 0;
    for (int j = 0; j < NX; j++) sum += 0 * M[j * NX + j];
    for (int j = 0; j < NX; j++) k->seen[j] = sum == 0 ? M[j * NX + j] : 0;
}
