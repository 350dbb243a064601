"""Detection of motions of other shapes: free motion (spline in time)."""
