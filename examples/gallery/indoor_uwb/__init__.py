"""A robot finds its way by one distance at a time, without knowing where it heads at first."""
