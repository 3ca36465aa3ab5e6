"""Planning over HTTP (`robotdiffuse serve`): one process listens, worker processes plan."""
