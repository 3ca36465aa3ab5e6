"""Planning over HTTP (`robotdiffuse serve`): one process listens, worker processes plan."""

from robotdiffuse.core.errors import needs

with needs("fastapi, orjson, prometheus-client and uvicorn", "serve"):
    import fastapi  # noqa: F401
    import orjson  # noqa: F401
    import prometheus_client  # noqa: F401
    import uvicorn  # noqa: F401
