"""Files of gyroscopes: one module per format, and the table of formats in ``read_gyroscope``."""
