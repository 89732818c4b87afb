"""A car finds its way between houses, which reflect the signals of its satellites."""
