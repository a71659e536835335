"""python -m filterlab: the same as the command `filterlab`."""

import sys

from filterlab.cli import main

sys.exit(main())
