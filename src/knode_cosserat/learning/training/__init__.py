"""Gradient training: losses, epochs, several seeds in parallel, checkpoints."""
