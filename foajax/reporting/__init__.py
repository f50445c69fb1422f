"""What runs add up to: scores, curves, costs, and the report of them."""
