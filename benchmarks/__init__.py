"""Timings of the stages and of whole runs, as ratios to a calibration kernel."""
