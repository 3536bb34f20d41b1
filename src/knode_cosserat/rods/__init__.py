"""Robot models: continuous equations of rods. No grid, no time step, no solver."""
