"""``python -m handavatar`` is ``handavatar``."""

import sys

from handavatar.cli import main

if __name__ == "__main__":
    sys.exit(main())
