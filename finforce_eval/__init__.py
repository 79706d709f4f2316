"""Recordings in; tables, pictures and calibrations out; the `finforce` command."""
