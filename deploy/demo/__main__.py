"""Start of the demo by `python -m deploy.demo`, which is the same as `gripmap demo`."""

import sys

from deploy.cli import main
from schemas.runtime.process import force_exit

if __name__ == "__main__":
    force_exit(main(["demo", *sys.argv[1:]]))
