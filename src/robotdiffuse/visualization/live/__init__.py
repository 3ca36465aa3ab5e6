"""The interactive page: a session, which knows nothing of browsers, and its view in one. Only the command
line imports this room."""
