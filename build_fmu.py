"""``python build_fmu.py`` builds the default arm's FMU; the options of ``twodof build``."""

import sys

from twodof.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["build", *sys.argv[1:]]))
