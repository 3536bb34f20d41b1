"""Training by gradients: losses, epochs, many seeds at once, checkpoints."""
