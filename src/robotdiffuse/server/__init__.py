"""Planning over HTTP: `robotdiffuse serve`. Worker processes plan, one process listens."""
