"""Search under path constraints."""
