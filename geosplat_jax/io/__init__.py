"""Files in and out, on the host: images, scenes and checkpoints.

Nothing here is traced by JAX, and no stage of the renderer imports it.
"""
