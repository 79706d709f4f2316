"""Recordings through the real nodes, in real time."""
