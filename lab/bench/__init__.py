"""Run time against error of everything that one image passes through."""
