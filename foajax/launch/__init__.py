"""How runs are started: one, a sweep, or one run in several processes."""
