"""How good a result is: image quality, offset errors, test targets."""
