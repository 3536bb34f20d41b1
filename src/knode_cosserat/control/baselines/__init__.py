"""Baselines of comparisons behind the interface of controllers: without a model, linear, and sampled."""
