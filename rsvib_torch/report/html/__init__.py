"""The HTML page about a stack."""
