/* Derivatives by x and u of by_f' f + <by_J, J> + by_h' h + <by_C, C>, with the rate f and the output
 * h at w = x, and their Jacobians J and C; matrices lie by rows. */
static void mhe_pull(const mhe_reduced *r, const real *w, const real *u, const real *by_f,
                     const real *by_J, const real *by_h, const real *by_C, real *by_x, real *by_u)
{
    (void)r;
    mhe_pull_functions(w, u, by_f, by_J, by_h, by_C, by_x, by_u);
}
