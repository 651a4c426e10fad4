"""A canvas that writes down what is drawn on it."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from triline.nodes.viewer.canvas import NullCanvas


class Notebook(NullCanvas):
    """A canvas that remembers: entity -> what was drawn last, and how often."""

    def __init__(self):
        self.drawn = {}
        self.times = defaultdict(int)
        self.curves = defaultdict(lambda: ([], []))
        self.styles, self.events, self.layouts, self.closed = {}, [], [], 0
        self.names = {}  # of lines
        self.moments = []

    def at(self, time_s):
        self.moments.append(time_s)

    def _note(self, entity, *what):
        self.drawn[entity] = what
        self.times[entity] += 1

    def points(self, entity, xyz, colors, radius, labels=None):
        assert len(colors) == len(xyz) and np.isfinite(xyz).all()
        self._note(entity, np.array(xyz), list(colors), labels)

    def lines(self, entity, strips, colors, radius, labels=None):
        assert labels is None or len(labels) == len(strips)
        self._note(entity, [np.array(s) for s in strips], colors)
        self.names[entity] = labels

    def arrows(self, entity, origins, vectors, colors, radius, labels=None):
        assert len(origins) == len(vectors) == len(colors)
        self._note(entity, np.array(origins), np.array(vectors), list(colors))

    def ellipsoids(self, entity, centres, half_axes, quaternions, color):
        self._note(entity, centres, half_axes, quaternions)

    def picture(self, entity, corners, grey):
        assert corners.shape == (4, 3) and grey.ndim == 2 and grey.dtype == np.uint8
        self._note(entity, np.array(corners), np.array(grey))

    def image(self, entity, grey, place, order):
        assert grey.ndim == 2 and grey.dtype == np.uint8
        self._note(entity, np.array(grey), place)

    def move(self, entity, place):
        self._note(entity, place)

    def geographic_line(self, entity, lat_lon, color):
        self._note(entity, np.array(lat_lon))

    def geographic_points(self, entity, lat_lon, colors, radius):
        self._note(entity, np.array(lat_lon), list(colors))

    def style(self, entity, series):
        self.styles[entity] = series

    def curve(self, entity, time_s, values):
        self.curves[entity][0].extend(time_s)
        self.curves[entity][1].extend(values)

    def event(self, entity, text, level):
        self.events.append((text, level))

    def clear(self, entity):
        for name in [name for name in self.drawn if name == entity or name.startswith(entity + "/")]:
            del self.drawn[name]

    def layout(self, layout):
        self.layouts.append(layout)

    def close(self):
        self.closed += 1

    def pieces(self, entity, column=0):
        """What all pieces of an entity hold, in order."""
        names = sorted((n for n in self.drawn if n.startswith(entity + "/")), key=lambda n: int(n.rsplit("/")[-1]))
        return [self.drawn[name][column] for name in names]
