"""Calls in other processes: workers on this machine, and a Ray cluster."""
