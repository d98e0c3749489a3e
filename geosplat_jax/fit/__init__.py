"""Fitting: settings, stages, the training step and the loop around it."""
