"""Studies: many dives, many estimators."""
