/* There is no set of $name. */

static const mhe_${letter}_set *mhe_${letter}_set_at(const mhe_settings *s, const mhe_stage *stage)
{
    (void)stage;
    return &s->$name;
}

static void mhe_take_own_$letter(mhe_stage *stage, const mhe_sample *sample)
{
    (void)stage; (void)sample;
}

static void mhe_complete_own_$letter(const mhe_settings *s, mhe_stage *stage)
{
    (void)s; (void)stage;
}
