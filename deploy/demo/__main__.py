"""Start of the demo by `python -m deploy.demo`, which is the same as `gripmap demo`."""

import sys

from deploy.cli import main

if __name__ == "__main__":
    sys.exit(main(["demo", *sys.argv[1:]]))
