"""python -m robotdiffuse, and so torchrun -m robotdiffuse"""

import sys

from robotdiffuse.cli import main

if __name__ == "__main__":
    sys.exit(main())
