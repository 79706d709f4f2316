"""Finite elements of the jaw: co-rotational solid and frame, and their factorisations."""
