"""``python -m twodof`` is ``twodof``."""

import sys

from .cli.main import main

sys.exit(main())
