"""The loop of one training run, and what watches over it."""
