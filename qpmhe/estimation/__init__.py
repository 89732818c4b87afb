"""The estimator's step in Python: window, problem, subproblem, optimizer, estimate."""
