"""The latest scans and images, and the smoother over them."""
