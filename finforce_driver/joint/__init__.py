"""Grippers that are a joint to others: a position that is commanded and reported, by topic or by action."""
