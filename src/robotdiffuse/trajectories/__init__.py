"""From a verified path to a timed trajectory and to files."""
