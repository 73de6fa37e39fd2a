"""The drives of one vehicle together: a random walk with steps, on the marginals of their results."""
