"""Assessment of a track: health, scores, calibration, causes of failure, pictures of a field."""
