"""Tie points out of image lines: interest points, search, least squares matching, consistency of all views."""
