"""What the physics misses, learned: knowledge and a residual make a KNODE, which is again a system."""
