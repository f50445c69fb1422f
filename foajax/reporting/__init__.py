"""Scores, curves and costs of runs, and the report of them."""
