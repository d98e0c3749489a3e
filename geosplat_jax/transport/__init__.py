"""Light transport: how light reaches a point of the surface and leaves it towards a viewer."""
