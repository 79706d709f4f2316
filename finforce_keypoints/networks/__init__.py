"""Key point networks: files, metadata, decoding, names."""
