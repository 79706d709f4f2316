"""Poses of the object: from messages, from a tracker, filtered and paired."""
