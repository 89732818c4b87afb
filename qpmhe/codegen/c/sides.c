/* Sets with other sides than the usual ones. */

/* A miss of a row counts as a share of its width, or of a standard deviation if that is less. */
static void mhe_set_scales(int count, const real *lower, const real *upper, const real *deviation,
                           real *scale)
{
    for (int i = 0; i < count; i++) {
        const real width = upper[i] - lower[i];
        scale[i] = width > 0 && width < deviation[i] ? width : deviation[i];
    }
}

/* The settings' set with the sides of another. */
#define TAKE_SIDES(own, set, n, count) do { \
        memcpy((own).rows, (set).rows, sizeof (own).rows); \
        memcpy((own).deviation, (set).deviation, sizeof (own).deviation); \
        memcpy((own).row_deviation, (set).row_deviation, sizeof (own).row_deviation); \
        memcpy((own).row_fixed, (set).row_fixed, sizeof (own).row_fixed); \
        mhe_set_scales(n, (own).lower, (own).upper, (own).deviation, (own).scale); \
        mhe_set_scales(count, (own).row_lower, (own).row_upper, (own).row_deviation, \
                       (own).row_scale); \
    } while (0)
