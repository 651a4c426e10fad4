"""The rectifier: image lines and orientations in, growing orthoimages out."""
