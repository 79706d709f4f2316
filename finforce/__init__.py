"""Grasp force from a wrist camera: what all packages share, and the door to them."""
