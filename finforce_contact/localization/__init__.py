"""Where the object's outline meets the deformed inner face."""
