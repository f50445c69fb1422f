"""Starts runs: one, a sweep, or one run in several processes."""
