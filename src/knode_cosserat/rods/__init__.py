"""What a robot is: continuous equations of rods. No grid, no time step, no solver."""
