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

void mhe_jacobians(int64_t count, const real *x, const real *u, const real *step, real usual,
                   real *f_jacobian, real *h_jacobian)
{
    real next[NX], y[NY];
    for (int64_t k = 0; k < count; k++, x += NX, u += NU) {
        if (f_jacobian)
            mhe_f_jacobian(x, u, step ? step[k] : usual, next, f_jacobian + k * NX * NX);
        if (h_jacobian) mhe_h_jacobian(x, u, y, h_jacobian + k * NY * NX);
    }
}
