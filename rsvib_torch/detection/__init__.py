"""From offsets to a vibration."""
