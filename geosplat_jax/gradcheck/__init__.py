"""Proof of the gradients: finite differences of every stage against reverse mode."""
