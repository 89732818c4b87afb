/* Differences of outputs and of states, a [-] b: a - b up to whole turns of angles. */

/* Turn differences into [-P/2, P/2) for the periods P of angles, 0 for no angle. */
static void mhe_turn(int n, const real *periods, real *differences)
{
    for (int j = 0; j < n; j++)
        if (periods[j] > 0)
            differences[j] -= floor(differences[j] / periods[j] + (real)0.5) * periods[j];
}

/* Turn differences a - b into those of the user's function of a and b, where they are others. */
static void mhe_turn_by(void (*function)(const real *, const real *, real *), int n, const real *a,
                        real *differences)
{
    real b[NX > NY ? NX : NY], values[NX > NY ? NX : NY];
    for (int j = 0; j < n; j++) b[j] = a[j] - differences[j];
    function(a, b, values);
    for (int j = 0; j < n; j++) {
        const real rounding = (real)0.5 * fabs(differences[j]) + 64 * EPSILON * fabs(a[j]);
        if (!(fabs(values[j] - differences[j]) <= rounding)) differences[j] = values[j];
    }
}

/* Turn differences y - b of outputs into y [-] b, in place. */
static void mhe_wrap_output(const mhe_settings *s, const real *y, real *differences)
{
$output    (void)s; (void)y; (void)differences;
}

/* Turn differences x - b of states into x [-] b, in place. */
static void mhe_wrap_state(const mhe_settings *s, const real *x, real *differences)
{
$state    (void)s; (void)x; (void)differences;
}

/* Move the angles of a state that X bounds by whole turns, to around the middle of their bounds. */
static void mhe_enter_turn(const mhe_settings *s, real *x)
{
    if (MHE_TURNS) {
        real middle[NX], apart[NX], turned[NX];
        for (int j = 0; j < NX; j++) {
            middle[j] = isfinite(s->turn_middle[j]) ? s->turn_middle[j] : x[j];
            apart[j] = turned[j] = x[j] - middle[j];
        }
        mhe_wrap_state(s, x, turned);
        for (int j = 0; j < NX; j++)
            if (turned[j] != apart[j]) x[j] = middle[j] + turned[j];
    }
    (void)s; (void)x;
}
