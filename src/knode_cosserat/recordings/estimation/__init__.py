"""State estimation: full states on the nodes of a model, from a recording."""
