"""``python -m sst_graph``."""

from sst_graph.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
