/* The point of a convex set nearest to another one, in a metric. */

/* One-sided inequalities a's <= b: components from above and from below, then rows likewise. */
#define SIDES (2 * (NX + MHE_X_ROWS))

/* A variance below this share of the largest possible one counts as zero: one of a covariance, and
 * one of a root that has more digits. */
#define SINGULAR (sizeof(real) == 8 ? (real)1e-12 : (real)1e-5)
#define SINGULAR_ROOT (sizeof(real) == 8 ? (real)1e-26 : (real)1e-10)

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
    const real *U; /* a root of the covariance, U'U */
    real singular, deviation[SIDES], reach[SIDES]; /* 0 without variance; the largest possible one */
    int count, active[NX];
    uint8_t is_active[SIDES];
    real multipliers[NX];
    real columns[NX * NX];                /* U a of each active side, in rows */
    real basis[NX * NX], triangle[NX * NX]; /* and their factors, likewise: B in rows, T */
} mhe_nearest;

/* U a of a side. */
static void mhe_side_spread(const mhe_nearest *n, int r, real *out)
{
    for (int i = 0; i < NX; i++)
        out[i] = r < 2 * NX ? n->U[i * NX + r % NX]
                            : mhe_dot(NX, n->U + i * NX, mhe_row_of(n->set, r));
    if (mhe_is_lower(r))
        for (int i = 0; i < NX; i++) out[i] = -out[i];
}

static void mhe_start_nearest(mhe_nearest *n, const mhe_x_set *set, const real *U, real singular)
{
    real variances[NX] = {0}, spread[NX];
    n->set = set, n->U = U, n->singular = singular, n->count = 0;
    memset(n->is_active, 0, sizeof n->is_active);
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) variances[j] += U[i * NX + j] * U[i * NX + j];
    for (int r = 0; r < SIDES; r++) {
        real possible = 0;
        mhe_side_spread(n, r, spread);
        const real variance = mhe_dot(NX, spread, spread);
        if (r < 2 * NX) {
            possible = variances[r % NX];
        } else {
            const real *row = mhe_row_of(set, r);
            for (int j = 0; j < NX; j++) possible += row[j] * row[j] * variances[j];
        }
        const int usable = variance > singular * possible;
        n->deviation[r] = usable ? sqrt(variance) : 0;
        n->reach[r] = usable ? sqrt(possible) / n->deviation[r] : 0;
    }
}

/* The shares of the first active sides in a column, which is left without them. */
static void mhe_take_shares(const mhe_nearest *n, int count, real *column, real *shares)
{
    for (int i = 0; i < count; i++) shares[i] = 0;
    for (int round = 0; round < 2; round++) /* again: what rounding has left of them */
        for (int i = 0; i < count; i++) {
            const real *b = n->basis + i * NX, share = mhe_dot(NX, b, column);
            shares[i] += share;
            for (int j = 0; j < NX; j++) column[j] -= share * b[j];
        }
}

/* Factors of the active sides from one on; whether these are independent. */
static int mhe_orthogonalise(mhe_nearest *n, int from)
{
    for (int i = from; i < n->count && i < NX; i++) { /* never more than NX: GCC for ARM warns else */
        real *b = n->basis + i * NX, shares[NX];
        memcpy(b, n->columns + i * NX, sizeof(real) * NX);
        mhe_take_shares(n, i, b, shares);
        const real norm = sqrt(mhe_dot(NX, b, b));
        if (!(norm > 0)) return 0;
        for (int j = 0; j < NX; j++) b[j] /= norm;
        for (int j = 0; j < i; j++) n->triangle[j * NX + i] = shares[j];
        n->triangle[i * NX + i] = norm;
    }
    return 1;
}

/* The multiplier i leaves; whether the others are independent. */
static int mhe_leave(mhe_nearest *n, int i)
{
    const int rest = --n->count - i;
    n->is_active[n->active[i]] = 0;
    for (int j = i; j < i + rest; j++) {
        n->active[j] = n->active[j + 1];
        n->multipliers[j] = n->multipliers[j + 1];
        memcpy(n->columns + j * NX, n->columns + (j + 1) * NX, sizeof(real) * NX);
    }
    return mhe_orthogonalise(n, i);
}

/* Make a side active that is missed by so many deviations, and others inactive if need be; 0 if
 * that is impossible. */
static int mhe_join(mhe_nearest *n, int side, real missed)
{
    real column[NX], own = 0;
    mhe_side_spread(n, side, column);
    for (int j = 0; j < NX; j++) column[j] /= n->deviation[side];
    for (int leaving = n->count; leaving >= 0; leaving--) { /* each time but the last, a side leaves */
        real left[NX], exchange[NX], largest = n->reach[side], length = INFINITY;
        int blocking = -1;
        memcpy(left, column, sizeof left);
        mhe_take_shares(n, n->count, left, exchange);
        for (int i = n->count - 1; i >= 0; i--) {
            for (int j = i + 1; j < n->count; j++) exchange[i] -= n->triangle[i * NX + j] * exchange[j];
            exchange[i] /= n->triangle[i * NX + i];
            largest += fabs(exchange[i]) * n->reach[n->active[i]];
        }
        const real curvature = mhe_dot(NX, left, left);
        if (n->count < NX && curvature > n->singular * largest * largest) length = missed / curvature;
        for (int i = 0; i < n->count; i++)
            if (exchange[i] > 0 && n->multipliers[i] / exchange[i] < length) {
                length = n->multipliers[i] / exchange[i];
                blocking = i;
            }
        if (!isfinite(length)) return 0;
        for (int i = 0; i < n->count; i++) n->multipliers[i] -= length * exchange[i];
        own += length;
        missed -= length * curvature;
        if (blocking < 0) break;
        if (!mhe_leave(n, blocking)) return 0;
    }
    const int last = n->count;
    if (last >= NX) return 0;
    n->count++;
    n->active[last] = side;
    n->is_active[side] = 1;
    n->multipliers[last] = own;
    memcpy(n->columns + last * NX, column, sizeof column);
    return mhe_orthogonalise(n, last);
}

/* s := s - U'z. */
static void mhe_move_along(const mhe_nearest *n, const real *z, real *s)
{
    for (int i = 0; i < NX; i++)
        for (int j = 0; j < NX; j++) s[j] -= n->U[i * NX + j] * z[i];
}

/* The point that the multipliers lead to, corrected to lie on the active sides. */
static void mhe_reach(mhe_nearest *n, const real *point, real *s)
{
    real z[NX] = {0}, gap[NX];
    for (int j = 0; j < NX; j++) s[j] = point[j];
    mhe_add_product(n->count, NX, 1, n->columns, n->multipliers, z);
    mhe_move_along(n, z, s);
    for (int round = 0; round < REFINEMENTS; round++) {
        int open = 0;
        for (int i = 0; i < n->count; i++) {
            const int r = n->active[i];
            const real missed = mhe_reading(n->set, r, s) - mhe_limit(n->set, r);
            open |= !(fabs(missed) <= 16 * EPSILON * mhe_reading_size(n->set, r, s));
            gap[i] = missed / n->deviation[r];
        }
        if (!open) break;
        for (int j = 0; j < NX; j++) z[j] = 0;
        for (int i = 0; i < n->count; i++) {
            for (int j = 0; j < i; j++) gap[i] -= n->triangle[j * NX + i] * gap[j];
            gap[i] /= n->triangle[i * NX + i];
            for (int j = 0; j < NX; j++) z[j] += gap[i] * n->basis[i * NX + j];
        }
        mhe_move_along(n, z, s);
    }
}

static void mhe_clip(const mhe_x_set *set, real *s)
{
    for (int j = 0; j < NX; j++) {
        if (s[j] < set->lower[j]) s[j] = set->lower[j];
        if (s[j] > set->upper[j]) s[j] = set->upper[j];
    }
}

/* out = the point of the set nearest to another one, in the metric of a covariance P = U'U that may be
 * singular: min |s - point|_{P^-1}, s = point - P a' lambda. The dual active-set method of Goldfarb
 * and Idnani (Mathematical Programming 27, 1983). 0 where a singular P leads to no such point. */
static int mhe_nearest_in(const mhe_x_set *set, const real *U, real singular, const real *point,
                          real *out)
{
    mhe_nearest n;
    real s[NX];
    mhe_start_nearest(&n, set, U, singular);
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

/* A metric: a root of its inverse, the covariance P, and the share of a variance that is none. */
typedef struct {
    real root[NX * NX], singular;
} mhe_metric;

/* The metric of a covariance; of its root, where that has more digits. */
static void mhe_set_metric(mhe_metric *m, const real *covariance, const real *root)
{
    m->singular = root ? SINGULAR_ROOT : SINGULAR;
    if (root) memcpy(m->root, root, sizeof m->root);
    else mhe_root(NX, covariance, m->root);
}

/* The same in any case; where P leads to no point of the set, the metric is diagonal, with the
 * sizes of the components as standard deviations, and the result 0. */
static int mhe_project(const mhe_x_set *set, const mhe_metric *P, const real *point, real *out)
{
    if (mhe_nearest_in(set, P->root, P->singular, point, out)) return 1;
    real other[NX * NX] = {0};
    for (int j = 0; j < NX; j++) {
        real size = fabs(point[j]);
        for (int r = 0; r < SIDES; r++) {
            const real slope = r < 2 * NX ? r % NX == j : fabs(mhe_row_of(set, r)[j]);
            const real limit = fabs(mhe_limit(set, r));
            if (slope > 0 && isfinite(limit)) size = mhe_max(limit / slope, size);
        }
        other[j * (NX + 1)] = size;
    }
    if (!mhe_nearest_in(set, other, SINGULAR, point, out)) {
        for (int j = 0; j < NX; j++) out[j] = point[j];
        mhe_clip(set, out);
    }
    return 0;
}
