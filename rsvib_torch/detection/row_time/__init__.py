"""Row time of a camera from the motion in its frames."""
