"""Surfaces: where they start, how they are penalised, and the tables of the isosurface."""
