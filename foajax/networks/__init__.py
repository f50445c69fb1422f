"""The recurrent network with two heads, and the operations that it is made of."""
