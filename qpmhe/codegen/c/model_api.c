/* The model at many states at once, for a caller in another language. `step` holds the
 * length of every step, or is a null pointer where all are `usual`. */

void mhe_values(int64_t count, const real *x, const real *u, const real *step, real usual,
                real *f, real *h)
{
    for (int64_t k = 0; k < count; k++, x += NX, u += NU) {
        if (f) mhe_f(x, u, step ? step[k] : usual, f + k * NX);
        if (h) mhe_h(x, u, h + k * NY);
    }
}

/* The values come with the Jacobians; a null pointer leaves out. */
void mhe_jacobians(int64_t count, const real *x, const real *u, const real *step, real usual,
                   real *f, real *h, real *f_jacobian, real *h_jacobian)
{
    real next[NX], y[NY];
    for (int64_t k = 0; k < count; k++, x += NX, u += NU) {
        if (f_jacobian)
            mhe_f_jacobian(x, u, step ? step[k] : usual, f ? f + k * NX : next,
                           f_jacobian + k * NX * NX);
        if (h_jacobian)
            mhe_h_jacobian(x, u, h ? h + k * NY : y, h_jacobian + k * NY * NX);
    }
}

/* The residual (w, v) of each stage along a trajectory of count + 1 states. */
void mhe_residuals(int64_t count, const real *x, const real *u, const real *step, real usual,
                   const real *y, real *residuals)
{
    real f[NX], h[NY];
    for (int64_t k = 0; k < count; k++, x += NX, u += NU, y += NY, residuals += NX + NY) {
        mhe_f(x, u, step ? step[k] : usual, f);
        mhe_h(x, u, h);
        for (int j = 0; j < NX; j++) residuals[j] = x[NX + j] - f[j];
        for (int j = 0; j < NY; j++) residuals[NX + j] = y[j] - h[j];
    }
}
