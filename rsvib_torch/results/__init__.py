"""What all results have: summary, dictionary, files, figures, and reasons against a result."""
