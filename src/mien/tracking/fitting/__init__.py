"""What every fit shares: its input, parameters, solver, state and stored pieces."""
