"""C code from CasADi models."""
