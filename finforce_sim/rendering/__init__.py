"""What the wrist camera makes of a scene: ray casting, light, sensor noise."""
