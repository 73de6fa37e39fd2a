"""How well a solution fits its labels: share of close points, residuals point by point, profile
likelihood."""
