"""The interfaces of other planners, so that programs written for them plan with this package."""
