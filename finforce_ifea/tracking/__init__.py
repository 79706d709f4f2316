"""The filter over images: from key points to the place, depth and force of a contact."""
