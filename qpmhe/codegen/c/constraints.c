/* Nonlinear constraints g(x, w, v, u) <= 0: values along a trial, and rows of a QP, which are linearised.
 * From the second QP on, the Hessian has the convex part of the curvature of those that held the last
 * solution back. Without w and v, a row also holds at the newest state. */

@mhe_trial
    mhe_real values[(MHE_HORIZON + 1) * MHE_G_ROWS]; /* of nonlinear constraints */
@types
/* Their arguments x, w and v, one below the other. */
#define MHE_V_AT (MHE_NX + (MHE_G_W > 0 ? MHE_G_W : MHE_NX))
#define MHE_JOINT (MHE_V_AT + MHE_NY)
@mhe_workspace
    /* Of nonlinear constraints: derivatives by the state and the next one, whether a row has none, and
     * the last QP's forces. */
    mhe_real own_slopes[(MHE_HORIZON + 1) * MHE_G_ROWS * MHE_NX];
    mhe_real next_slopes[MHE_HORIZON * MHE_G_ROWS * MHE_NX];
    mhe_real pushes[(MHE_HORIZON + 1) * MHE_G_ROWS];
    uint8_t unusable[(MHE_HORIZON + 1) * MHE_G_ROWS];
    int32_t has_pushes, has_bends, trial_failed;
    mhe_real change[MHE_JOINT * MHE_JOINT], directions_of[MHE_JOINT * MHE_JOINT];
    mhe_real moved[MHE_JOINT * 2 * MHE_NX];
@mhe_estimate
    uint8_t trial_failed; /* whether a constraint has had no value along a trial that led no further */
@
/* Step of second derivatives, as a share of the deviations. */
#define MOVE (sizeof(real) == 8 ? (real)0.000244140625 : (real)0.015625)

/* Whether a row holds at state i: not on missing outputs. */
static int mhe_counts(mhe_estimator *e, int i, int r)
{
    const mhe_settings *s = e->settings;
    if (i == e->length) return s->constraints.on_state[r];
    const mhe_stage *stage = mhe_stage_at(e, i);
    for (int j = 0; j < NY && !stage->is_complete; j++)
        if (s->constraints.touched[r * NY + j] && !stage->is_observed[j]) return 0;
    return 1;
}

/* x, w and v of state i, one below the other. */
static void mhe_joint(const mhe_estimator *e, int i, const mhe_trial *trial, real *joint)
{
    const int is_last = i == e->length;
    const real *d = trial->w + i * NX;
    for (int j = 0; j < NX; j++) joint[j] = trial->x[i * NX + j];
    for (int j = 0; j < MHE_V_AT - NX; j++) {
        joint[NX + j] = 0;
        if (is_last) continue;
        joint[NX + j] = MHE_G_W ? mhe_dot(NX, e->settings->constraints.through + j * NX, d) : d[j];
    }
    for (int j = 0; j < NY; j++) joint[MHE_V_AT + j] = is_last ? 0 : trial->v[i * NY + j];
}

/* own += slope times the derivative of component c of (x, w, v) by the state, and next by the next one. */
static void mhe_add_moved(const mhe_estimator *e, const mhe_workspace *k, int i, int c, real slope, real *own,
                          real *next)
{
    if (c < NX) {
        own[c] += slope;
        return;
    }
    if (c >= MHE_V_AT || !MHE_G_W) {
        const real *moving = c >= MHE_V_AT ? k->at[i]->h_jacobian + (c - MHE_V_AT) * NX
                                           : k->at[i]->f_jacobian + (c - NX) * NX;
        for (int j = 0; j < NX; j++) own[j] -= slope * moving[j];
        if (c < MHE_V_AT) next[c - NX] += slope;
        return;
    }
    const real *through = e->settings->constraints.through + (c - NX) * NX;
    for (int l = 0; l < NX; l++) {
        const real share = slope * through[l];
        if (share == 0) continue;
        next[l] += share;
        for (int j = 0; j < NX; j++) own[j] -= share * k->at[i]->f_jacobian[l * NX + j];
    }
}

/* Values along a trial: 0 of rows that do not count, infinite where a number is not finite. */
static void mhe_set_values(mhe_estimator *e, mhe_trial *trial)
{
    for (int i = 0; i <= e->length; i++) {
        real joint[MHE_JOINT], *values = trial->values + i * MHE_G_ROWS;
        mhe_joint(e, i, trial, joint);
        mhe_call_g(joint, mhe_stage_of_state(e, i)->u, values);
        for (int r = 0; r < MHE_G_ROWS; r++) {
            values[r] *= e->settings->constraints.factor[r];
            if (!isfinite(values[r])) values[r] = INFINITY;
            if (!mhe_counts(e, i, r)) values[r] = 0;
        }
    }
}

/* Whether all values of a trial are finite. */
static int mhe_has_values(const mhe_estimator *e, const mhe_trial *trial)
{
    return mhe_each_finite((e->length + 1) * MHE_G_ROWS, trial->values);
}

static void mhe_value_distances(mhe_estimator *e, int i, const mhe_trial *trial, real *low, real *high)
{
    for (int r = 0; r < MHE_G_ROWS; r++) {
        low[r] = -INFINITY;
        high[r] = mhe_counts(e, i, r) ? -trial->values[i * MHE_G_ROWS + r] : INFINITY;
    }
}

static void mhe_value_scales(const mhe_settings *s, real *scale, real *deviation)
{
    for (int r = 0; r < MHE_G_ROWS; r++) scale[r] = deviation[r] = s->constraints.scale[r];
}

/* The largest miss of a hard row, in its scale. `missed` gets the sides that are. */
static real mhe_values_missed(const mhe_settings *s, const real *high, const uint8_t *left_out,
                              uint8_t *missed)
{
    real worst = 0;
    for (int r = 0; r < MHE_G_ROWS; r++) {
        const real share = -high[r] / s->constraints.scale[r];
        if (isnan(share)) return INFINITY;
        if (!(share > 0) || mhe_is_soft(s, G_AT + r) || (left_out && left_out[r])) continue;
        worst = mhe_max(share, worst);
        if (missed && share > MHE_FEASIBLE) missed[r] = MHE_UPPER;
    }
    return worst;
}

/* Derivatives of the rows around a trial; those of rows that have none are zeros. */
static void mhe_linearize_constraints(mhe_estimator *e, mhe_workspace *k, const mhe_trial *around)
{
    const mhe_settings *s = e->settings;
    for (int i = 0; i < mhe_row_stages(e); i++) {
        const int is_last = i == e->length;
        real *own = k->own_slopes + i * MHE_G_ROWS * NX, joint[MHE_JOINT];
        real *next = is_last ? own : k->next_slopes + i * MHE_G_ROWS * NX;
        real values[MHE_G_ROWS], slopes[SIZE(MHE_G_NONZEROS)];
        mhe_joint(e, i, around, joint);
        mhe_call_g_jacobian(joint, mhe_stage_of_state(e, i)->u, values, slopes);
        for (int j = 0; j < MHE_G_ROWS * NX; j++) own[j] = next[j] = 0;
        for (int q = 0; q < MHE_G_NONZEROS; q++) {
            const int r = mhe_g_row[q], c = mhe_g_column[q];
            const real slope = slopes[q] * s->constraints.factor[r];
            if (is_last && !s->constraints.on_state[r]) continue;
            mhe_add_moved(e, k, i, c, slope, own + r * NX, next + r * NX);
        }
        for (int r = 0; r < MHE_G_ROWS; r++) {
            const int usable = isfinite(around->values[i * MHE_G_ROWS + r]) &&
                               mhe_each_finite(NX, own + r * NX) && mhe_each_finite(NX, next + r * NX);
            k->unusable[i * MHE_G_ROWS + r] = !usable;
            for (int j = 0; j < NX && !usable; j++) own[r * NX + j] = next[r * NX + j] = 0;
        }
    }
}

/* The derivative of a row of stage i by component j of its state or of the next one. */
static real mhe_value_slope(const mhe_workspace *k, int i, int r, int following, int j)
{
    return (following ? k->next_slopes : k->own_slopes)[(i * MHE_G_ROWS + r) * NX + j];
}

/* Rows that cannot be linearised have no limits. */
static void mhe_leave_out(const mhe_workspace *k, int i, real *high)
{
    for (int r = 0; r < MHE_G_ROWS; r++)
        if (k->unusable[i * MHE_G_ROWS + r]) high[r] = INFINITY;
}

/* What the rows of stage i are at increments d. */
static void mhe_slopes_times(const mhe_estimator *e, const mhe_workspace *k, int i, const real *d,
                             real *value)
{
    const real *own = k->own_slopes + i * MHE_G_ROWS * NX;
    for (int r = 0; r < MHE_G_ROWS; r++) value[r] = mhe_dot(NX, own + r * NX, d + i * NX);
    if (i == e->length) return;
    const real *next = k->next_slopes + i * MHE_G_ROWS * NX;
    for (int r = 0; r < MHE_G_ROWS; r++) value[r] += mhe_dot(NX, next + r * NX, d + (i + 1) * NX);
}

static void mhe_add_slope_loads(const mhe_estimator *e, const mhe_workspace *k, int i,
                                const real *load, real *out)
{
    for (int r = 0; r < MHE_G_ROWS; r++) {
        const int at = (i * MHE_G_ROWS + r) * NX;
        if (load[r] == 0) continue;
        for (int j = 0; j < NX; j++) out[i * NX + j] += load[r] * k->own_slopes[at + j];
        for (int j = 0; i < e->length && j < NX; j++)
            out[(i + 1) * NX + j] += load[r] * k->next_slopes[at + j];
    }
}

/* pliancy[r] += a D^-1 a' of the rows of stage i, a their slopes; the sums of |a d| in `sizes`. */
static void mhe_add_slope_pliancy(mhe_estimator *e, const mhe_workspace *k, int i, const real *d,
                                  real *pliancy, real *sizes)
{
    for (int following = 0; following < 2 && i + following <= e->length; following++) {
        const real *slopes = following ? k->next_slopes : k->own_slopes;
        const real *moved = d + (i + following) * NX;
        real D[NX];
        mhe_stage_curvature(e, k, i + following, D);
        for (int r = 0; r < MHE_G_ROWS; r++)
            for (int j = 0; j < NX; j++) {
                const real slope = slopes[(i * MHE_G_ROWS + r) * NX + j];
                pliancy[r] += slope * slope / D[j];
                sizes[r] += fabs(slope * moved[j]);
            }
    }
}

static void mhe_slope_stiffness(mhe_estimator *e, const mhe_workspace *k, int i, const int8_t *place,
                                real *pliancy)
{
    real found[MHE_G_ROWS] = {0}, sizes[MHE_G_ROWS] = {0};
    int active = 0;
    for (int r = 0; r < MHE_G_ROWS; r++) active |= place[r] != 0;
    if (active) mhe_add_slope_pliancy(e, k, i, k->step, found, sizes);
    for (int r = 0; r < MHE_G_ROWS; r++)
        if (place[r] != 0) pliancy[r] = found[r];
}

/* Scales of rows of stage i, as those of X become: `least` is rounding's share of a value. */
static void mhe_sharpen_values(mhe_estimator *e, mhe_workspace *k, int i, real least)
{
    real pliancy[MHE_G_ROWS] = {0}, sizes[MHE_G_ROWS] = {0}, *scale = k->rows.scale + i * ROWS + G_AT;
    mhe_add_slope_pliancy(e, k, i, k->step, pliancy, sizes);
    for (int r = 0; r < MHE_G_ROWS; r++) {
        const real found = mhe_max(sqrt(pliancy[r]), least * sizes[r]);
        if (found > 0 && found < scale[r]) scale[r] = found;
    }
}

/* The values that a second-order correction is about: those of the best trial, moved by what their
 * linearisation misses at the spare one, where rows.value is what it says. */
static void mhe_bend_values(mhe_estimator *e, mhe_workspace *k, const mhe_trial *best,
                            const mhe_trial *spare)
{
    for (int i = 0; i < mhe_row_stages(e); i++)
        for (int r = 0; r < MHE_G_ROWS; r++) {
            const int at = i * MHE_G_ROWS + r;
            const real missed = spare->values[at] - best->values[at] - k->rows.value[i * ROWS + G_AT + r];
            k->bent.values[at] = best->values[at] + (isfinite(missed) ? missed : 0);
        }
}

/* rows.value of stage i = what the linearisation misses. */
static void mhe_missed_values(mhe_workspace *k, int i, const mhe_trial *best)
{
    for (int r = 0; r < MHE_G_ROWS; r++) {
        const int at = i * MHE_G_ROWS + r;
        if (isfinite(best->values[at]))
            k->rows.value[i * ROWS + G_AT + r] = k->bent.values[at] - best->values[at];
    }
}

/* A new sequence of QPs begins. */
static void mhe_forget_pushes(mhe_workspace *k)
{
    k->has_pushes = k->has_bends = 0;
    k->trial_failed = 0;
}

/* Note a trial that leads no further. */
static void mhe_note_trial(const mhe_estimator *e, mhe_workspace *k, const mhe_trial *trial)
{
    if (!mhe_has_values(e, trial)) k->trial_failed = 1;
}

static void mhe_fill_trial_failed(const mhe_workspace *k, mhe_estimate *out)
{
    out->trial_failed = k->trial_failed != 0;
}

/* Keep the forces of a QP's solution, of its active set or of its interior point. */
static void mhe_keep_pushes(mhe_estimator *e, mhe_workspace *k, int is_solved, int is_exact)
{
    const mhe_rows *q = &k->rows;
    int is_finite = 1;
    real largest = 0;
    for (int i = 0; i < mhe_row_stages(e); i++)
        for (int r = 0; r < MHE_G_ROWS; r++) {
            const int at = i * ROWS + G_AT + r;
            const real force = is_exact ? mhe_whole_force(q, at) : q->sides[1].dual[at];
            k->pushes[i * MHE_G_ROWS + r] = mhe_max(force, 0);
            largest = mhe_max(largest, force);
            is_finite &= isfinite(force) != 0;
        }
    k->has_pushes = is_solved && is_finite && largest > 0;
}

/* The rows of one constraint, from `first` to before `end`, at state i: a convex part of its curvature
 * along the components of (x, w, v) that it depends on, into the blocks of the states. */
static void mhe_bend_group(mhe_estimator *e, mhe_workspace *k, int i, const mhe_trial *around,
                           int first, int end)
{
    const mhe_settings *s = e->settings;
    const real *push = k->pushes + i * MHE_G_ROWS, *u = mhe_stage_of_state(e, i)->u;
    const real *deviations = s->constraints.deviations;
    real joint[MHE_JOINT], values[MHE_G_ROWS], slopes[SIZE(MHE_G_NONZEROS)];
    real *M = k->change, *V = k->directions_of;
    int place[MHE_JOINT], used[MHE_JOINT], count = 0;
    for (int c = 0; c < MHE_JOINT; c++) place[c] = -1;
    for (int q = 0; q < MHE_G_NONZEROS; q++) {
        const int r = mhe_g_row[q], c = mhe_g_column[q];
        if (r < first || r >= end || !(push[r] > 0) || place[c] >= 0) continue;
        used[count] = c;
        place[c] = count++;
    }
    mhe_joint(e, i, around, joint);
    for (int j = 0; j < count * count; j++) M[j] = 0;
    for (int a = 0; a < count; a++)
        for (int sign = 1; sign >= -1; sign -= 2) {
            const real usual = joint[used[a]];
            joint[used[a]] = usual + (real)sign * MOVE * deviations[used[a]];
            mhe_call_g_jacobian(joint, u, values, slopes);
            joint[used[a]] = usual;
            for (int q = 0; q < MHE_G_NONZEROS; q++) {
                const int r = mhe_g_row[q], c = mhe_g_column[q];
                if (r < first || r >= end || !(push[r] > 0)) continue;
                M[a * count + place[c]] += (real)sign * push[r] * s->constraints.factor[r] * slopes[q];
            }
        }
    for (int a = 0; a < count; a++)
        for (int b = 0; b < count; b++) M[a * count + b] *= deviations[used[b]] / (2 * MOVE);
    if (!mhe_each_finite(count * count, M)) return;
    mhe_symmetrise(count, M);
    mhe_eigen(count, M, V);
    memset(k->moved, 0, sizeof k->moved);
    for (int a = 0; a < count; a++) /* derivatives of the components by the states */
        mhe_add_moved(e, k, i, used[a], 1, k->moved + 2 * a * NX, k->moved + (2 * a + 1) * NX);
    for (int l = 0; l < count; l++) { /* along each direction that is curved upwards */
        const real bend = M[l * count + l];
        real by_state[NX], by_next[NX];
        if (!(bend > 0)) continue;
        for (int j = 0; j < NX; j++) by_state[j] = by_next[j] = 0;
        for (int a = 0; a < count; a++) {
            const real share = V[l * count + a] / deviations[used[a]];
            for (int j = 0; j < NX; j++) {
                by_state[j] += share * k->moved[2 * a * NX + j];
                by_next[j] += share * k->moved[(2 * a + 1) * NX + j];
            }
        }
        mhe_keep_bend(e, k, i, bend, by_state, by_next);
    }
}

/* The curvature of the rows that the last QP's forces push against, around a trial. */
static void mhe_set_bends(mhe_estimator *e, mhe_workspace *k, const mhe_trial *around)
{
    const int32_t *group = e->settings->constraints.group;
    k->has_bends = k->has_pushes;
    if (!k->has_pushes) return;
    mhe_clear_bends(k);
    for (int i = 0; i < mhe_row_stages(e); i++)
        for (int first = 0; first < MHE_G_ROWS; first++) {
            int pushed = 0, end = first;
            if (first > 0 && group[first] == group[first - 1]) continue;
            for (; end < MHE_G_ROWS && group[end] == group[first]; end++)
                pushed |= k->pushes[i * MHE_G_ROWS + end] > 0;
            if (pushed) mhe_bend_group(e, k, i, around, first, end);
        }
}
