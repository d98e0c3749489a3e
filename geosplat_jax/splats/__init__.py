"""Gaussian splats: projection, visibility and compositing."""
