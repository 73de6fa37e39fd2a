"""The initialization: a global search, its candidates, and the selection among them."""
