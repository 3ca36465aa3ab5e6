"""The interactive page: a session, which is independent of browsers, and its view in the browser."""
