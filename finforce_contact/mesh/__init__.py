"""Object meshes: reading, repair, decimation, views."""
