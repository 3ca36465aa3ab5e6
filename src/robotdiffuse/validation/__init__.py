"""Validation of paths and trajectories: collision, limits, rates, torques, start, goal and waypoints."""
