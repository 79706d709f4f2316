"""Many recordings, one task each: one after the other, in processes, or on a Ray cluster."""
