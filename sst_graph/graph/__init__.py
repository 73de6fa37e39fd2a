"""The factor graph: state, matching, building, and the outer loop that matches again."""
