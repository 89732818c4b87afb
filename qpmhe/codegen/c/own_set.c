/* The set of $name: the usual one, or that of a sample. */

static const mhe_${letter}_set *mhe_${letter}_set_at(const mhe_settings *s, const mhe_stage *stage)
{
    return stage->has_own_$letter ? &stage->own_$letter : &s->$name;
}

static void mhe_take_own_$letter(mhe_stage *stage, const mhe_sample *sample)
{
    stage->has_own_$letter = sample->$name != 0;
    if (stage->has_own_$letter) stage->own_$letter = *sample->$name;
}

/* Complete the set of a sample, in which only the sides are known. */
static void mhe_complete_own_$letter(const mhe_settings *s, mhe_stage *stage)
{
    if (stage->has_own_$letter) TAKE_SIDES(stage->own_$letter, s->$name, $size, MHE_${capital}_ROWS);
}
