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

/* The residual (w, v) of a stage from its state and the next one, which follows it. */
static void mhe_residual(const real *x, const real *u, real step, const real *y, real *residual)
{
    real f[NX], h[NY];
    mhe_f(x, u, step, f);
    mhe_h(x, u, h);
    for (int j = 0; j < NX; j++) residual[j] = x[NX + j] - f[j];
    for (int j = 0; j < NY; j++) residual[NX + j] = y[j] - h[j];
}

/* Residuals of each stage along a trajectory of count + 1 states. */
void mhe_residuals(int64_t count, const real *x, const real *u, const real *step, real usual,
                   const real *y, real *residuals)
{
    for (int64_t k = 0; k < count; k++, x += NX, u += NU, y += NY, residuals += NX + NY)
        mhe_residual(x, u, step ? step[k] : usual, y, residuals);
}

#define NQ (NX + NY)
#define NM (1 + NX)
#define BAND (2 * NX * NX)

/* product = W M; weights are diagonal more often than not. */
static void mhe_weigh(int columns, const real *W, const real *M, real *product)
{
    for (int i = 0; i < NQ; i++) {
        real *row = product + i * columns;
        for (int j = 0; j < columns; j++) row[j] = 0;
        for (int k = 0; k < NQ; k++) {
            const real w = W[i * NQ + k];
            if (w == 0) continue;
            for (int j = 0; j < columns; j++) row[j] += w * M[k * columns + j];
        }
    }
}

/* Stage k of a window with a constant gain: its residual and minus its Jacobian as [r, -G], its
 * Gauss-Newton terms, the state after it, and its cost, which is NaN
 * where any of these is not finite. All arrays hold one entry a stage; W is the joint weight. */
real mhe_enter_stage(real *x, const real *us, const real *ys, real usual, const real *gain,
                     const real *W, real *linear, real *panel, real *own, real *following, int k)
{
    const real *z = x + k * NX, *u = us + k * (NU + 1), *y = ys + k * NY;
    real *next = x + (k + 1) * NX, *M = linear + k * NQ * NM;
    real output[NY], A[NX * NX], C[NY * NX], WM[NQ * NM], S[NM * NM];
    mhe_f_jacobian(z, u, usual, next, A);
    mhe_h_jacobian(z, u, output, C);
    for (int j = 0; j < NY; j++) {
        M[(NX + j) * NM] = y[j] - output[j];
        for (int i = 0; i < NX; i++) M[(NX + j) * NM + 1 + i] = -C[j * NX + i];
    }
    for (int j = 0; j < NX; j++) {
        real sum = 0;
        for (int i = 0; i < NY; i++) sum += gain[j * NY + i] * M[(NX + i) * NM];
        M[j * NM] = sum;
        next[j] += sum;
        for (int i = 0; i < NX; i++) M[j * NM + 1 + i] = -A[j * NX + i];
    }
    mhe_weigh(NM, W, M, WM);
    for (int i = 0; i < NM * NM; i++) S[i] = 0;
    for (int l = 0; l < NQ; l++)
        for (int i = 0; i < NM; i++) {
            const real m = M[l * NM + i];
            if (m == 0) continue;
            for (int j = 0; j < NM; j++) S[i * NM + j] += m * WM[l * NM + j];
        }
    for (int c = 0; c < NX; c++)
        for (int o = 0; o < 2 * NX; o++) {
            const int r = c + o;
            panel[k * BAND + c * 2 * NX + o] = r < NX ? S[(1 + r) * NM + 1 + c]
                                : r < 2 * NX ? WM[(r - NX) * NM + 1 + c] : 0;
        }
    for (int j = 0; j < NX; j++) {
        own[k * NX + j] = S[(1 + j) * NM];
        following[k * NX + j] = WM[j * NM];
    }
    real nothing = 0; /* NaN if anything is not finite: 0 times infinity is, too */
    for (int i = 0; i < NM * NM; i++) nothing += 0 * S[i];
    for (int i = 0; i < NQ * NM; i++) nothing += 0 * M[i];
    for (int j = 0; j < NX; j++) nothing += 0 * next[j];
    return S[0] + nothing;
}

/* Residuals along a trajectory of count + 1 states, and its cost, as the window's stages from
 * `first` on have it: measurements, inputs, and the prior, which is the state there. */
real mhe_judge(const real *prior, const real *us, const real *ys, real usual, const real *W,
               const real *P, const real *x, real *residuals, int first, int count)
{
    real offset[NX], weighted[NQ], cost = 0;
    for (int j = 0; j < NX; j++) offset[j] = x[j] - prior[first * NX + j];
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) cost += offset[i] * P[i * NX + j] * offset[j];
    for (int k = first; k < first + count; k++, x += NX, residuals += NQ) {
        mhe_residual(x, us + k * (NU + 1), usual, ys + k * NY, residuals);
        mhe_weigh(1, W, residuals, weighted);
        for (int i = 0; i < NQ; i++) cost += weighted[i] * residuals[i];
    }
    return cost;
}
