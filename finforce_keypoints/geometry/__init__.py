"""From pixels and depth to points in the jaw's frame."""
