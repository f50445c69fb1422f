"""Compares runs: scores, curves, costs, the report, and runs that are kept."""
