/* Losses that are widened while the first window fills. */

/* By what the losses of w and of v are widened now. Without a workspace: not at all. */
static real mhe_w_widening(const mhe_workspace *k)
{
    return k ? k->w_widening : 1;
}

static real mhe_v_widening(const mhe_workspace *k)
{
    return k ? k->v_widening : 1;
}
