"""The trajectory before any image: filters and smoothers for attitude and GNSS, and for inertial data.

``kinematic.py`` takes measured attitude and GNSS. ``error_state.py`` is the filter of inertial data and GNSS:
``post_processing.py`` runs it over a recording, ``inertial_navigator.py`` sample by sample.
"""
