/* Steps of QPs with inequalities: where one does not lower the cost, shorter ones along it, and back to
 * the sets. */

/* Make the spare trial the first one along the step whose cost is below the best so far, or the
 * last one. A useless step, whose promised decrease is negligible, is not shortened: at a minimum
 * none lowers the cost by more than rounding. Nor is a damped one. */
static void mhe_lower(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real promised, int useless)
{
    static const real lengths[] = MHE_LENGTHS;
    const int count = (int)(sizeof lengths / sizeof *lengths);
    const real target = mhe_target(o);
    const int shorten = !useless && !(o->present > 0);
    (void)promised;
    mhe_try(e, k, o, 1);
    if (o->spare->cost < target) return;
    if (mhe_try_curved(e, k, o, target, useless)) return;
    for (int i = 0; i < count && shorten; i++) {
        mhe_try(e, k, o, lengths[i]);
        if (o->spare->cost < target) return;
    }
    if (shorten) mhe_try_along(e, k, o, target);
}

static void mhe_forget_region(mhe_workspace *k, mhe_outcome *o)
{
    (void)k; (void)o;
}

static void mhe_follow_region(mhe_estimator *e, mhe_workspace *k, mhe_outcome *o, real lowered)
{
    (void)e; (void)k; (void)o; (void)lowered;
}
