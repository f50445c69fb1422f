"""The games: one interface, the engines behind it, and tasks of our own."""
