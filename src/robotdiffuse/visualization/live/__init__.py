"""The interactive page: a session, which is independent of browsers, and its view in the browser."""

from robotdiffuse.core.errors import needs

with needs("viser", "live"):
    import viser  # noqa: F401
