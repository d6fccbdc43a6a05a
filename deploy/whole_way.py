"""`python -m deploy.whole_way`: old name of the command `python -m deploy.end_to_end`."""

import sys

from deploy.end_to_end import main

if __name__ == "__main__":
    sys.exit(main())
