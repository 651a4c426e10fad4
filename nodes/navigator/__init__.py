"""The navigator: sensors in, measured trajectory of the camera out."""
