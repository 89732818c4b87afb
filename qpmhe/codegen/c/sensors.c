/* How often in a row each sensor has failed. */

@mhe_estimate
    uint8_t rejected[MHE_SENSORS]; /* 1 for each sensor that the observer's gate rejected */
@mhe_log
    uint8_t *rejected;             /* MHE_SENSORS each */
@
/* Behind stage i the sensors' counts are those before it, or zero. */
static void mhe_keep_rejections(mhe_estimator *e, int i)
{
    const mhe_stage *stage = mhe_stage_at(e, i);
    memcpy(mhe_next_rejections(e, i), stage->rejections, sizeof stage->rejections);
}

static void mhe_forget_rejections(mhe_estimator *e, int i)
{
    memset(mhe_next_rejections(e, i), 0, sizeof e->rejections_end);
}

/* Which sensors the observer rejected at the newest stage. */
static void mhe_fill_rejected(mhe_estimator *e, uint8_t *out)
{
    const mhe_stage *newest = mhe_stage_at(e, e->length - 1);
    for (int k = 0; k < MHE_SENSORS; k++)
        out[k] = MHE_REJECTS && e->rejections_end[k] > newest->rejections[k];
}

static void mhe_fill_sensors(mhe_estimator *e, mhe_estimate *out)
{
    mhe_fill_rejected(e, out->rejected);
}

static void mhe_log_sensors(mhe_estimator *e, const mhe_log *log, int64_t at)
{
    if (log->rejected) mhe_fill_rejected(e, log->rejected + at * MHE_SENSORS);
}
