"""Detection of sinusoidal tones in measured displacements."""
