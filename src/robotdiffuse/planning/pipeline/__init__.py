"""Planning with moving obstacles, waypoints, a start velocity and unknown space, for any planner.

The modules handle one of these features each. A module calls `Planner.attempt`, once or several times, for
problems without the feature.
"""
