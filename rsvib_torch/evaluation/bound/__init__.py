"""Cramér-Rao bound of the parameters of a vibration."""
