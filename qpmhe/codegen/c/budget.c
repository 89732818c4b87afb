/* The time budget of a step. */

@mhe_settings
    double time_budget;        /* seconds from the start of a step, after which no QP begins */
    double (*clock)(void);     /* seconds from any start; a null pointer: no budget is kept */
@mhe_workspace
    double (*clock)(void), deadline; /* of the present step */
@
static void mhe_begin(const mhe_estimator *e, mhe_workspace *k)
{
    const mhe_settings *s = e->settings;
    k->clock = s->time_budget > 0 ? s->clock : 0;
    if (k->clock) k->deadline = k->clock() + s->time_budget;
}

static int mhe_time_is_up(const mhe_workspace *k)
{
    return k->clock && k->clock() > k->deadline;
}

/* Whether no time is left; it is an event then. */
static int mhe_is_late(const mhe_workspace *k, mhe_outcome *o)
{
    if (!mhe_time_is_up(k)) return 0;
    o->events |= MHE_TIME_UP;
    return 1;
}
