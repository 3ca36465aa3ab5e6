"""Motion planning for robot arms: `import robotdiffuse as rd`; every motion is verified.

The public names stand in `__init__.pyi`. Each is imported when it is first used, since the compiled kernels
take a second to load.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
