"""An object's mesh and pose from one masked depth image."""
