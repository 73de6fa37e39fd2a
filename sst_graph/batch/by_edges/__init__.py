"""Method edges: without labels, in the joint method's graph."""
