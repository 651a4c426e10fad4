"""The adjuster: measured trajectory, tie points and control in; refined orientation, object points and reports out."""
