"""Models of other packages as systems."""
