"""Recordings in and out: bags, tracks, images, objects."""
