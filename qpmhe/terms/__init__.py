"""The cost J of a window as a sum of terms.

Each term has a class for all windows of an estimator, made once, whose ``of_window`` gives the
`Term` of one window.
"""
