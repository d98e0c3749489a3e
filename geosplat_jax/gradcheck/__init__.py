"""Proof of the gradients: finite differences of every part against reverse mode."""
