"""Slow references of the method: plain loops in float64 numpy, sharing no code with the package.

Each module follows the equations of its sources literally, without a thought for speed, range or
padding. Every number may carry trailing axes of *lanes*, which `lanes.gradient` fills with complex
perturbations to differentiate along all inputs at once. `cases` holds the inputs and cotangents
from which `tests/data/make.py` writes the stored oracles.
"""
