"""From photographs with cameras to masks: splats with colours of their own, and a box."""
