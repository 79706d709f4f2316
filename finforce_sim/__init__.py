"""Synthetic scenes: objects, a depth camera with its faults, and what the truth of them is."""
