"""From the file of a printed finger to a jaw file."""
