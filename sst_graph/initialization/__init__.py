"""Where a solution begins: the global search, its candidates, and which of them is right."""
