"""The experiments of the paper, each by one command: cases that can be resumed, figures, and a page."""
