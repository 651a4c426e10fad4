"""The line camera: its sensor lines, the collinearity equations and self-calibration."""
