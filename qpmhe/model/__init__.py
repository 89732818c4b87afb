"""Models: systems, their functions and derivatives, sets, discretisation, unknown parameters."""
