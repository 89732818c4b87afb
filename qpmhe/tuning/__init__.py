"""Weights from data, and diagnostics that need no truth."""
