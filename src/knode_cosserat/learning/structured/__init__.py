"""The structured residual: terms in the places that mechanics leaves open, solved for in closed form."""
