"""Motion of the image on the sensor: timing of rows, the base class of motions, vibrations, splines, recordings."""
