"""Other methods, re-implemented from their papers and repositories, on the same frames as ours."""
