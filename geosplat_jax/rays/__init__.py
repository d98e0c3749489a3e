"""Rays against surfaces: occlusion and nearest hits."""
