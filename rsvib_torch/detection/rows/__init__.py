"""Direct measurement of displacements, row by row, around a motion estimate."""
