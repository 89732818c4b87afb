"""Forty variables of weather on a circle, and the figures that others publish on it."""
