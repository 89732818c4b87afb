/* All losses are quadratic. */

/* The loss of s, widened: m rho(q / m). */
static real mhe_lost(const mhe_loss *loss, real m, int n, const real *W, const real *s)
{
    (void)loss; (void)m;
    return mhe_form(n, W, s);
}

/* What the rows of W are multiplied with in the form that touches the widened loss at s; a loss of
 * each component has a diagonal W. */
static void mhe_set_scale(const mhe_loss *loss, real m, int n, const real *W, const real *s,
                          real *scale)
{
    (void)loss; (void)m; (void)n; (void)W; (void)s; (void)scale;
}

static real mhe_scaled(real weight, const real *scale, int row)
{
    (void)scale; (void)row;
    return weight;
}

static void mhe_scale_weights(const mhe_settings *s, const mhe_workspace *k,
                              const mhe_stage *stage, const real *Q, const real *w, const real *v,
                              mhe_terms *t)
{
    (void)s; (void)k; (void)stage; (void)Q; (void)w; (void)v; (void)t;
}
