"""A motor's inertia, which the data do not see while the speed is steady."""
