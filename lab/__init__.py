"""Evaluation of the product: benchmarks, stress, the paper's experiments and training; not installed."""
