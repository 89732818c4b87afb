"""The cost J of a window as a sum of terms."""
