"""Estimators for any model of few parameters: regularised least squares, the mixed model, transforms of the plane."""
