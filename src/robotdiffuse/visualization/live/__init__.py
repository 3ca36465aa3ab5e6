"""The interactive page: a session, which does not depend on browsers, and a page that shows it in
browsers."""

from robotdiffuse.core.errors import needs

with needs("viser", "live"):
    import viser  # noqa: F401
