/* Projection of the observer onto X: the nearest point in the observer's own metric. */

/* One-sided inequalities a's <= b: components from above and from below, then rows likewise. */
#define SIDES (2 * (NX + MHE_X_ROWS))

/* A variance below this share of the largest possible one counts as zero. */
#define SINGULAR (sizeof(real) == 8 ? (real)1e-12 : (real)1e-5)

/* Most corrections that put a point on its active sides. */
#define REFINEMENTS 4

static real mhe_limit(const mhe_x_set *set, int r)
{
    if (r < NX) return set->upper[r];
    if (r < 2 * NX) return -set->lower[r - NX];
    r -= 2 * NX;
    return r < MHE_X_ROWS ? set->row_upper[r] : -set->row_lower[r - MHE_X_ROWS];
}

/* The general inequality that side r, not of a component, belongs to. */
static const real *mhe_row_of(const mhe_x_set *set, int r)
{
    r -= 2 * NX;
    return set->rows + (r < MHE_X_ROWS ? r : r - MHE_X_ROWS) * NX;
}

static int mhe_is_lower(int r) { return r < 2 * NX ? r >= NX : r >= 2 * NX + MHE_X_ROWS; }

/* a's of side r. */
static real mhe_reading(const mhe_x_set *set, int r, const real *s)
{
    const real value = r < 2 * NX ? s[r % NX] : mhe_dot(NX, mhe_row_of(set, r), s);
    return mhe_is_lower(r) ? -value : value;
}

/* The sum of the magnitudes of the terms of a's - b. */
static real mhe_reading_size(const mhe_x_set *set, int r, const real *s)
{
    real size = fabs(mhe_limit(set, r));
    if (r < 2 * NX) return size + fabs(s[r % NX]);
    const real *row = mhe_row_of(set, r);
    for (int j = 0; j < NX; j++) size += fabs(row[j] * s[j]);
    return size;
}

/* By how much a point misses side r; 0 where only by rounding. */
static real mhe_side_missed(const mhe_x_set *set, int r, const real *s)
{
    const real limit = mhe_limit(set, r);
    if (!isfinite(limit)) return 0;
    const real missed = mhe_reading(set, r, s) - limit;
    return missed > 16 * EPSILON * mhe_reading_size(set, r, s) ? missed : 0;
}

/* Whether a point is in the set, up to rounding in general inequalities. */
static int mhe_is_inside(const mhe_x_set *set, const real *s)
{
    for (int j = 0; j < NX; j++)
        if (!(set->lower[j] <= s[j] && s[j] <= set->upper[j])) return 0; /* NaN, too */
    for (int r = 2 * NX; r < SIDES; r++)
        if (mhe_side_missed(set, r, s) > 0) return 0;
    return 1;
}

/* The search for the nearest point. Sides are in units of their standard deviations. */
typedef struct {
    const mhe_x_set *set;
    const real *P;
    real deviation[SIDES], reach[SIDES]; /* 0 without variance; the largest possible deviation */
    int count, active[NX];
    uint8_t is_active[SIDES];
    real multipliers[NX];
    real spread[NX * NX];  /* P a of each active side */
    real gram[NX * NX], factor[NX * NX]; /* a' P a of each two active sides */
} mhe_nearest;

static void mhe_start_nearest(mhe_nearest *n, const mhe_x_set *set, const real *P)
{
    n->set = set, n->P = P, n->count = 0;
    memset(n->is_active, 0, sizeof n->is_active);
    for (int r = 0; r < SIDES; r++) {
        real variance = 0, possible = 0;
        if (r < 2 * NX) {
            variance = P[(r % NX) * (NX + 1)];
            possible = fabs(variance);
        } else {
            const real *row = mhe_row_of(set, r);
            variance = mhe_form(NX, P, row);
            for (int j = 0; j < NX; j++) possible += row[j] * row[j] * fabs(P[j * (NX + 1)]);
        }
        const int usable = variance > SINGULAR * possible;
        n->deviation[r] = usable ? sqrt(variance) : 0;
        n->reach[r] = usable ? sqrt(possible) / n->deviation[r] : 0;
    }
}

/* b := gram^-1 b for the active sides; whether gram is positive definite. */
static int mhe_solve_active(mhe_nearest *n, real *b)
{
    const int count = n->count;
    for (int i = 0; i < count; i++)
        for (int j = 0; j < count; j++) n->factor[i * count + j] = n->gram[i * NX + j];
    if (!mhe_decompose(count, n->factor)) return 0;
    mhe_solve_for(count, n->factor, 1, b);
    return 1;
}

/* The multiplier i leaves. */
static void mhe_leave(mhe_nearest *n, int i)
{
    const int rest = --n->count - i;
    n->is_active[n->active[i]] = 0;
    for (int j = 0; j < rest; j++) {
        n->active[i + j] = n->active[i + j + 1];
        n->multipliers[i + j] = n->multipliers[i + j + 1];
        memcpy(n->spread + (i + j) * NX, n->spread + (i + j + 1) * NX, sizeof(real) * NX);
        memcpy(n->gram + (i + j) * NX, n->gram + (i + j + 1) * NX, sizeof(real) * NX);
    }
    for (int j = 0; j < n->count; j++) {
        real *row = n->gram + j * NX;
        memmove(row + i, row + i + 1, sizeof(real) * (size_t)rest);
    }
}

/* Make a side active that is missed by so many deviations, and others inactive if need be; 0 if
 * that is impossible. */
static int mhe_join(mhe_nearest *n, int side, real missed)
{
    real spread[NX], column[NX], exchange[NX], own = 0, variance;
    const real unit = 1 / n->deviation[side];
    if (side < 2 * NX) {
        const real sign = mhe_is_lower(side) ? -unit : unit;
        for (int j = 0; j < NX; j++) spread[j] = sign * n->P[j * NX + side % NX];
    } else {
        const real sign = mhe_is_lower(side) ? -unit : unit;
        mhe_times(NX, n->P, mhe_row_of(n->set, side), spread);
        for (int j = 0; j < NX; j++) spread[j] *= sign;
    }
    variance = mhe_reading(n->set, side, spread) * unit;
    for (;;) {
        real curvature = variance, largest = n->reach[side], length = INFINITY;
        int blocking = -1;
        for (int i = 0; i < n->count; i++) {
            const int r = n->active[i];
            column[i] = exchange[i] = mhe_reading(n->set, r, spread) / n->deviation[r];
        }
        if (!mhe_solve_active(n, exchange)) return 0;
        for (int i = 0; i < n->count; i++) {
            curvature -= column[i] * exchange[i];
            largest += fabs(exchange[i]) * n->reach[n->active[i]];
        }
        if (n->count < NX && curvature > SINGULAR * largest * largest) length = missed / curvature;
        for (int i = 0; i < n->count; i++)
            if (exchange[i] > 0 && n->multipliers[i] / exchange[i] < length) {
                length = n->multipliers[i] / exchange[i];
                blocking = i;
            }
        if (!isfinite(length)) return 0;
        for (int i = 0; i < n->count; i++) n->multipliers[i] -= length * exchange[i];
        own += length;
        missed -= length * mhe_max(curvature, 0);
        if (blocking < 0) break;
        mhe_leave(n, blocking);
    }
    const int last = n->count;
    if (last >= NX) return 0;
    n->count++;
    n->active[last] = side;
    n->is_active[side] = 1;
    n->multipliers[last] = own;
    memcpy(n->spread + last * NX, spread, sizeof spread);
    for (int i = 0; i < last; i++) {
        n->gram[last * NX + i] = column[i];
        n->gram[i * NX + last] = column[i];
    }
    n->gram[last * NX + last] = variance;
    return 1;
}

/* The point that the multipliers lead to, corrected to lie on the active sides. */
static void mhe_reach(mhe_nearest *n, const real *point, real *s)
{
    real gap[NX];
    for (int j = 0; j < NX; j++) s[j] = point[j];
    for (int i = 0; i < n->count; i++)
        for (int j = 0; j < NX; j++) s[j] -= n->multipliers[i] * n->spread[i * NX + j];
    for (int round = 0; round < REFINEMENTS; round++) {
        int open = 0;
        for (int i = 0; i < n->count; i++) {
            const int r = n->active[i];
            const real missed = mhe_reading(n->set, r, s) - mhe_limit(n->set, r);
            open |= !(fabs(missed) <= 16 * EPSILON * mhe_reading_size(n->set, r, s));
            gap[i] = missed / n->deviation[r];
        }
        if (!open || !mhe_solve_active(n, gap)) break;
        for (int i = 0; i < n->count; i++)
            for (int j = 0; j < NX; j++) s[j] -= gap[i] * n->spread[i * NX + j];
    }
}

static void mhe_clip(const mhe_x_set *set, real *s)
{
    for (int j = 0; j < NX; j++) {
        if (s[j] < set->lower[j]) s[j] = set->lower[j];
        if (s[j] > set->upper[j]) s[j] = set->upper[j];
    }
}

/* out = the point of the set nearest to another one, in the metric of a covariance P that may be
 * singular: min |s - point|_{P^-1}, s = point - P a' lambda. The dual active-set method of Goldfarb
 * and Idnani (Mathematical Programming 27, 1983). 0 where a singular P leads to no such point. */
static int mhe_nearest_in(const mhe_x_set *set, const real *P, const real *point, real *out)
{
    mhe_nearest n;
    real s[NX];
    mhe_start_nearest(&n, set, P);
    memcpy(s, point, sizeof s);
    for (int i = 0; i < 50 + 10 * SIDES; i++) {
        int worst = -1;
        real most = 0;
        for (int r = 0; r < SIDES; r++) {
            const real missed = n.is_active[r] ? 0 : mhe_side_missed(set, r, s);
            const real share = n.deviation[r] > 0 ? missed / n.deviation[r] : missed;
            if (share > most) most = share, worst = r;
        }
        if (worst < 0) {
            mhe_clip(set, s);
            /* Exactly on its bounds, not beside them by rounding: there, a model may have a huge
             * derivative where it has none on the bound. */
            for (int j = 0; j < NX; j++) {
                if (n.is_active[j]) s[j] = set->upper[j];
                if (n.is_active[NX + j]) s[j] = set->lower[j];
            }
            memcpy(out, s, sizeof s);
            return 1;
        }
        if (!(n.deviation[worst] > 0) || !mhe_join(&n, worst, most)) return 0;
        mhe_reach(&n, point, s);
    }
    return 0;
}

/* The same in any case; where P leads to no point of the set, the metric is diagonal, with the
 * sizes of the components as standard deviations, and the result 0. */
static int mhe_project(const mhe_x_set *set, const real *P, const real *point, real *out)
{
    if (mhe_nearest_in(set, P, point, out)) return 1;
    real other[NX * NX] = {0};
    for (int j = 0; j < NX; j++) {
        real size = fabs(point[j]);
        for (int r = 0; r < SIDES; r++) {
            const real slope = r < 2 * NX ? r % NX == j : fabs(mhe_row_of(set, r)[j]);
            const real limit = fabs(mhe_limit(set, r));
            if (slope > 0 && isfinite(limit)) size = mhe_max(limit / slope, size);
        }
        other[j * (NX + 1)] = size * size;
    }
    if (!mhe_nearest_in(set, other, point, out)) {
        for (int j = 0; j < NX; j++) out[j] = point[j];
        mhe_clip(set, out);
    }
    return 0;
}

/* Whether a point is farther from the set than any two points of the set are apart. */
static int mhe_is_beyond(const mhe_x_set *set, const real *P, const real *point,
                         const real *nearest)
{
    real scratch[NX * NX], metric[NX * NX], offset[NX], widths[NX], most = 0;
    for (int j = 0; j < NX; j++) {
        offset[j] = point[j] - nearest[j];
        widths[j] = set->upper[j] - set->lower[j];
        if (!isfinite(widths[j])) return 0;
    }
    memcpy(scratch, P, sizeof scratch);
    if (!mhe_invert(NX, scratch, metric)) return 0;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) most += widths[i] * fabs(metric[i * NX + j]) * widths[j];
    return mhe_form(NX, metric, offset) > most;
}

/* Keep the observer's next state in X, and set its correction w to match; bits of the status.
 * `predicted`: without the correction. */
static int mhe_keep_inside(const mhe_x_set *set, const real *P, const real *predicted, real *next,
                           real *w)
{
    real point[NX];
    int events = MHE_OBSERVER_PROJECTED, reached = mhe_project(set, P, next, point);
    if (!mhe_is_inside(set, predicted)) {
        events |= MHE_PREDICTION_OUTSIDE;
        if (reached && mhe_is_beyond(set, P, next, point)) {
            /* Every point of X is nearer to the truth than `next` is. The prediction is then so far
             * off that it would hide the correction: correct its projection instead. */
            real inside[NX];
            mhe_project(set, P, predicted, inside);
            for (int j = 0; j < NX; j++) inside[j] += w[j];
            reached = mhe_project(set, P, inside, point);
        }
    }
    for (int j = 0; j < NX; j++) {
        next[j] = point[j];
        w[j] = point[j] - predicted[j];
    }
    return reached ? events : events | MHE_METRIC_SINGULAR;
}

/* The metric of the projection, as a covariance: the observer's, or with `project` of 2 its diagonal,
 * which is made in `other`. */
static const real *mhe_metric_taken(const mhe_estimator *e, const real *own, real *other)
{
    if (e->settings->project < 2) return own;
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) other[i * NX + j] = i == j ? own[i * NX + j] : 0;
    return other;
}

/* Put a state of the observer into a set to which no correction leads. */
static void mhe_put_inside(const mhe_estimator *e, const mhe_x_set *set, const real *metric,
                           real *state)
{
    real point[NX], other[NX * NX];
    if (!e->settings->project || mhe_is_inside(set, state)) return;
    mhe_project(set, mhe_metric_taken(e, metric, other), state, point);
    memcpy(state, point, sizeof point);
}
