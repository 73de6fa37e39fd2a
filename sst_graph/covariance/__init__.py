"""Covariance of an estimate: cluster-robust, with considered assumptions; weak directions."""
