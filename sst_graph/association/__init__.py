"""Which data belong together: images and scans in time, points and pixels, edges and contours."""
