/* The time budget of a step, where there is a clock. */

static void mhe_begin(const mhe_estimator *e, mhe_workspace *k)
{
#if MHE_CLOCK
    const mhe_settings *s = e->settings;
    k->clock = s->time_budget > 0 ? s->clock : 0;
    if (k->clock) k->deadline = k->clock() + s->time_budget;
#endif
    (void)e; (void)k;
}

static int mhe_time_is_up(const mhe_workspace *k)
{
#if MHE_CLOCK
    return k->clock && k->clock() > k->deadline;
#else
    (void)k;
    return 0;
#endif
}
