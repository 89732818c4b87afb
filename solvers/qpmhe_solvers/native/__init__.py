"""Backends that set a solver up once, and from then on only hand it new numbers."""
