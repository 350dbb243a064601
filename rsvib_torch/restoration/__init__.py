"""How frames become a scene."""
