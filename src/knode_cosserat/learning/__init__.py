"""Learning of model errors: a nominal model and a residual form a KNODE, which is again a system."""
