"""Grasps controlled by a camera's force."""
