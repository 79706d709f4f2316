"""Detectors of key points in an image: a network on the side plane or the whole image, or dots."""
