"""The sums that the covariance of a running estimate is made from."""
