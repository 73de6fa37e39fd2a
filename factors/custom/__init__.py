"""What gtsam 4.3 does not do for a factor written in Python.

Checked callbacks, variables of any type, Jacobians compared with numerical ones, copies, other keys, pickles,
graduated non-convexity.
"""
