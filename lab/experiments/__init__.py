"""The experiments of the letter, each by one command: cases that can be resumed, figures, and a page."""
