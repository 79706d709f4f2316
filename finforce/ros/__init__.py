"""Nodes: parameters, quality of service, messages, diagnostics, start and stop."""
