/* No loss is widened. */

/* By what the losses of w and of v are widened now. Without a workspace: not at all. */
static real mhe_w_widening(const mhe_workspace *k)
{
    (void)k;
    return 1;
}

static real mhe_v_widening(const mhe_workspace *k)
{
    (void)k;
    return 1;
}
