"""``python -m sst_graph.cli``."""

import sys

from sst_graph.cli import main

if __name__ == "__main__":
    sys.exit(main())
