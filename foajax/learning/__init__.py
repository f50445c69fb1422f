"""The agent and how it learns: returns, losses, optimiser, and the compiled programs."""
