"""What the simulation gets wrong, its cause, the extended model, and what it gains on held-out data."""
