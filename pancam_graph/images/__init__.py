"""From image files to observations: reading, features, matching, tracks."""
