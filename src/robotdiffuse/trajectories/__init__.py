"""From a path to a timed trajectory: simplification, rounded corners, speeds within limits, jerk, stops."""
