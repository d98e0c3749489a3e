"""What every other module stands on: types, safe numerics, buffers of bounded size."""
