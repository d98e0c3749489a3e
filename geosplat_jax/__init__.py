"""Inverse rendering on any machine: photographs in; mesh, PBR materials and light out."""

__version__ = "0.1.0"
