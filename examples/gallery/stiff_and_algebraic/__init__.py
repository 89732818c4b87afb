"""A stiff reactor, a fed-batch fermentation and a small grid: implicit steps, beside do-mpc."""
