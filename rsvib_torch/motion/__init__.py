"""Motion of the image on the sensor: timing of the rows, vibrations, splines in time, recorded motions."""
