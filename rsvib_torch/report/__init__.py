"""Results on disk: JSON and CSV files, plots and HTML pages."""
