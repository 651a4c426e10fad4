"""The matcher: image lines and the orientation of now in, tie points and targets out."""
