"""Stored equilibria of a jaw: built once, evaluated in microseconds."""
