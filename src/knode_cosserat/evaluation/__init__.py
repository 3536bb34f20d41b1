"""How well a prediction matches a reference."""
